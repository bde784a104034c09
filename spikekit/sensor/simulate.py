"""Simulation of a sensor: from light to spikes, in one call or chunk by chunk."""

from __future__ import annotations

import torch
from torch import Tensor

from spikekit.check import check_planes, check_positive
from spikekit.sensor.integrate_fire import spike_integrate_fire
from spikekit.sensor.noise import NoisyPixels, SensorNoise, random_numbers


class SpikeSensor:
    r"""A simulated sensor that is exposed to light chunk by chunk.

    Convention:
        Time is axis -3. The light passes through :class:`SensorNoise` and :func:`spikekit.spike_integrate_fire`. The
        initial charge of every pixel is uniform in [0, threshold), as in a camera that is already running. The sensor
        keeps the charge and the clock, so chunks of light give the same spikes as the whole, bit for bit. No gradient.

        The same seed and light give the same spikes on every device. With leading dimensions, every (H, W) is a
        separate sensor.

    Args:
        noise: noise of the sensor; default: none.
        threshold: charge of one spike.
        seed: random seed, 0 or more.
        charge: initial charge, broadcastable to :math:`(*, H, W)`, below the threshold; default: random.

    Raises:
        ValueError: ``threshold`` is not above 0, or ``seed`` is negative.

    Example:
        >>> light = torch.rand(40, 6, 8)
        >>> sensor = SpikeSensor(SensorNoise(photons=100, dark_current=0.01), seed=1)
        >>> first, second = sensor.expose(light[:15]), sensor.expose(light[15:])
        >>> whole = SpikeSensor(SensorNoise(photons=100, dark_current=0.01), seed=1).expose(light)
        >>> bool((torch.cat([first, second]) == whole).all())
        True
    """

    def __init__(
        self,
        noise: SensorNoise | None = None,
        *,
        threshold: float = 1.0,
        seed: int = 0,
        charge: Tensor | None = None,
    ) -> None:
        check_positive("threshold", threshold)
        if seed < 0:
            raise ValueError(f"seed: expected 0 or more, got {seed}")
        self.noise = SensorNoise() if noise is None else noise
        self.threshold, self.seed = threshold, seed
        self.charge, self.clock = charge, 0
        self._pixels: NoisyPixels | None = None

    def expose(self, light: Tensor) -> Tensor:
        """Return the spikes of the next chunk of light.

        Args:
            light: charge per clock, :math:`(*, T, H, W)`, floating; chunks of one recording have the same
                :math:`(*, H, W)`.

        Returns:
            ``spikes`` of shape :math:`(*, T, H, W)`, uint8.

        Raises:
            TypeError: ``light`` is not a floating-point tensor.
            ValueError: ``light`` has fewer than three dimensions, or its size differs from that of earlier light or of
                the charge.
        """
        check_planes("light", light, 3, "(*, T, H, W)", floating=True)
        size = light.shape[:-3] + light.shape[-2:]
        if self._pixels is None:
            self._pixels = NoisyPixels(self.noise, tuple(size), self.seed)
        if self._pixels.size != tuple(size):
            raise ValueError(f"light: expected the size {self._pixels.size} as before, got {tuple(size)}")
        if self.charge is None:
            fraction = random_numbers(self.seed, "charge").random(size, dtype="float32")
            wide = torch.promote_types(light.dtype, torch.float32)
            self.charge = torch.from_numpy(fraction).to(light.device, wide) * self.threshold
        charge = self._pixels.charge(light, self.threshold, self.clock)
        spikes, self.charge = spike_integrate_fire(charge, self.threshold, self.charge, dtype=torch.uint8)
        self.clock += light.shape[-3]
        return self._pixels.spikes(spikes)


def simulate_spikes(
    light: Tensor,
    *,
    threshold: float = 1.0,
    noise: SensorNoise | None = None,
    charge: Tensor | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Simulate the spikes of a sensor in given light, with a random initial charge and optional noise.

    .. math:: c_0 \sim U[0, \theta), \quad S = \text{spikes of } I'_t \text{ from } c_0

    Convention:
        A single exposure of a :class:`SpikeSensor`; I' is the charge of :class:`SensorNoise`. The same generator state
        gives the same initial charge with and without noise. No gradient.

    Args:
        light: charge per clock, :math:`(*, T, H, W)`, floating, on the generator's device.
        threshold: :math:`\theta`, charge of one spike.
        noise: noise of the sensor; default: none.
        charge: initial charge, broadcastable to :math:`(*, H, W)`, below the threshold; default: random.
        generator: random generator; default: torch's.

    Returns:
        ``spikes``, uint8, :math:`(*, T, H, W)`.

    Raises:
        TypeError: ``light`` is not a floating-point tensor.
        ValueError: ``light`` has fewer than three dimensions, ``threshold`` is not above 0, or ``charge`` has another
            size.

    Example:
        >>> spikes = simulate_spikes(torch.full((40, 8, 8), 0.25), generator=torch.Generator().manual_seed(0))
        >>> spikes.dtype, spikes.sum(0).unique().tolist()
        (torch.uint8, [10])

    Reference:
        Dong et al., CVPR 2024, section 5.1.
    """
    if charge is None:
        check_planes("light", light, 3, "(*, T, H, W)", floating=True)
        size, dtype = light.shape[:-3] + light.shape[-2:], torch.promote_types(light.dtype, torch.float32)
        charge = torch.rand(size, generator=generator, device=light.device, dtype=dtype) * threshold
    seed = 0
    if noise is not None:
        seed = int(torch.randint(2**63 - 1, (), generator=generator, device=light.device))
    return SpikeSensor(noise, threshold=threshold, seed=seed, charge=charge).expose(light)
