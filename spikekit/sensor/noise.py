"""Noise of a sensor: photon noise, dark current, fixed-pattern noise, hot and dead pixels, quantisation."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from spikekit.check import check_size, check_whole

# Each purpose has a random stream of its own, given by its index: append, never reorder.
_PURPOSES = ("charge", "gain", "dark current", "defects", "photons", "electrons")

_MEAN_SIZE = math.sqrt(2 / math.pi)  # E|x| of a standard normal x
# At a dark current of 1 a pixel fires at every clock; with larger spreads nearly all pixels would see nothing.
_MOST = {"dark_current": 1.0, "dark_spread": 10.0, "gain_spread": 10.0, "hot": 1.0, "dead": 1.0}
_MOST_PHOTONS = 1e18  # NumPy's Poisson numbers are limited to 9.2e18, and shot noise is negligible here


#: Values of ``defects`` of a calibration: the pixel works, never fires, or always fires.
WORKS, DEAD, HOT = 0, 1, 2


class MeasuredPixels(Protocol):
    """Protocol of a measured sensor, such as a :class:`spikekit.Calibration`; all planes are (H, W)."""

    gain: Tensor
    dark: Tensor
    defects: Tensor


class SpikeChange(NamedTuple):
    """Effect of one source of noise, see :meth:`SensorNoise.spike_changes`.

    Args:
        charge: mean absolute error of a pixel's charge at the end of the clip, in thresholds, which is the error of its
            spike count.
        share: upper bound of the share of bits that differ.
    """

    charge: float
    share: float


@dataclass(frozen=True)
class SensorNoise:
    r"""Noise of a real sensor; every source is off by default.

    .. math:: I'_t = \theta \, (g \, P_t + D_t), \quad
        P_t \sim \operatorname{Poisson}(p I_t / \theta) / p, \quad
        D_t \sim \operatorname{Poisson}(p \, d) / p, \quad
        \mathrm{E} g = 1, \; \sigma(g) = \sigma_g, \quad \mathrm{E} d = \bar d, \; \sigma(d) = \sigma_d \bar d

    Convention:
        :math:`I_t` is the light of a pixel at a clock, :math:`\theta` the threshold, and :math:`I'_t` the charge that
        the pixel integrates. Charges are in thresholds, so settings do not depend on the threshold. Without
        ``photons``, light and dark current arrive evenly: :math:`P_t = I_t / \theta`, :math:`D_t = d`.

        Gain g and dark current d are constant for every pixel. They are log-normally distributed: close to normal for
        spreads of a few per cent, but always above 0, and with the given mean.

        A hot pixel fires at every clock; a dead one never fires. No pixel is both. A larger share keeps the defects of
        a smaller one.

        Negative light has no photon noise and is unchanged, and so are NaN and infinity.

        Every source has a random stream of its own, derived from the seed, and temporal noise a new one at every clock.
        A source therefore does not affect the others, and results do not depend on chunks. Random numbers are drawn on
        the CPU, and are the same on every device.

    Args:
        photons: p, electrons per threshold, at least 1; ``None`` for no photon noise.
        dark_current: :math:`\bar d`, mean dark current per clock, in thresholds, at most 1.
        dark_spread: :math:`\sigma_d`, standard deviation of the dark current over the pixels, relative to its mean, at
            most 10.
        gain_spread: :math:`\sigma_g`, standard deviation of the gain over the pixels (fixed-pattern noise), at most 10.
        hot: share of pixels that always fire.
        dead: share of pixels that never fire.
        calibration: gain, dark current and defects of a measured sensor, a :class:`spikekit.Calibration`, instead of
            random ones; the other options except ``photons`` must then be 0.

    Raises:
        ValueError: a number is out of range, the shares of hot and dead pixels add up to more than 1, ``dark_spread``
            is given without a dark current, or a calibration is combined with options that it replaces.

    Example:
        The constants of Hu et al. for a camera of 250 x 400 pixels at 20 kHz are given without units; here they are
        read as fF, V and pA. The threshold is a charge of 4.35 fF x 1.09 V, or 30 000 electrons. A dark current of 0.44
        pA, with a standard deviation of 39 %, gives 0.0047 thresholds per clock. Gains have a standard deviation of
        6 %:

        >>> typical = SensorNoise(photons=30_000, dark_current=0.0047, dark_spread=0.39, gain_spread=0.06)
        >>> for source, change in typical.spike_changes(light=0.2, frames=41).items():
        ...     print(f"{source}: {change.charge:.3f} thresholds, at most {change.share:.1%} of the bits")
        photons: 0.013 thresholds, at most 1.8% of the bits
        dark_current: 0.193 thresholds, at most 19.3% of the bits
        gain_spread: 0.393 thresholds, at most 29.8% of the bits

    Reference:
        Hu et al., SCSim: a realistic spike cameras simulator, arXiv:2405.16790, 2024 (constants: ``v2s.py`` of its
        code, after measurements in Hu et al., Spike stream denoising via spike camera simulation, arXiv:2304.03129,
        2023); Gao et al., The analysis and suppressing of non-uniformity in a high-speed spike-based image sensor,
        Sensors 18(12), 4232, 2018: shot noise, and gain and dark current that differ between pixels.
    """

    photons: float | None = None
    dark_current: float = 0.0
    dark_spread: float = 0.0
    gain_spread: float = 0.0
    hot: float = 0.0
    dead: float = 0.0
    calibration: MeasuredPixels | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.photons is not None and not 1 <= self.photons < math.inf:
            raise ValueError(f"photons: expected a finite number, 1 or more, got {self.photons}")
        for name, most in _MOST.items():
            value = getattr(self, name)
            if not 0 <= value <= most:
                raise ValueError(f"{name}: expected 0 to {most:g}, got {value}")
        if self.hot + self.dead > 1:
            raise ValueError(f"hot, dead: expected shares that add up to at most 1, got {self.hot}, {self.dead}")
        if self.dark_spread and not self.dark_current:
            raise ValueError(f"dark_spread: expected a dark_current above 0, got {self.dark_spread} without one")
        drawn = [name for name in ("dark_current", "gain_spread", "hot", "dead") if getattr(self, name)]
        if self.calibration is not None and drawn:
            raise ValueError(f"{drawn[0]}: expected 0 with a calibration, got {getattr(self, drawn[0])}")

    def spike_changes(self, light: float, frames: int) -> dict[str, SpikeChange]:
        r"""Predict the effect of each active source on a clip, without simulating it.

        .. math:: \text{share} \le \frac{1}{T} \sum_{t=1}^{T} \min(\mathrm{E}|E_{t-1}| + \mathrm{E}|E_t|, \;
            r + r', \; 1)

        Convention:
            Let :math:`Q_t` be the accumulated charge of a pixel up to clock t, and :math:`E_t` the part added by the
            source. The pixel fires at clock t if a multiple of the threshold lies in :math:`(Q_{t-1}, Q_t]` without the
            source, or in :math:`(Q_{t-1} + E_{t-1}, Q_t + E_t]` with it. The bits can differ only if a multiple lies
            between the two lower ends or between the two upper ends. As the initial charge is uniform in
            [0, threshold), these have the probabilities :math:`\min(1, |E_{t-1}|)` and :math:`\min(1, |E_t|)` in any
            light. The number of differing bits is also bounded by the bits set with (:math:`r'`) and without
            (:math:`r`) the source. In constant light the bound is nearly tight until the errors reach the light of one
            clock, or its distance to the threshold.

            Mean errors in thresholds: photons, :math:`\sqrt{2 t I / \pi p}` for many photons, else that of a Poisson
            number; dark current, :math:`t \bar d`; gains, at most :math:`\sqrt{2 / \pi} \, t I \sigma_g`. Hot pixels
            change :math:`1 - I` of their bits and dead ones I, with errors of :math:`(1 - I) T` and :math:`I T`.

            For light that differs between pixels, below the threshold, the mean can be used. The sum of the shares is a
            bound for all sources together.

        Args:
            light: mean light per clock, in thresholds.
            frames: T, clocks of the clip.

        Returns:
            One :class:`SpikeChange` per active source, by the name of its field; ``dark_spread`` is part of
            ``dark_current``. A calibration is not included.

        Raises:
            ValueError: ``light`` is negative or not finite, or ``frames`` is below 1.
        """
        if not 0 <= light < math.inf:
            raise ValueError(f"light: expected a finite number, 0 or more, got {light}")
        clocks = np.arange(check_whole("frames", frames) + 1)
        rate = min(1.0, light)

        def change(errors: np.ndarray, noisy: float = rate) -> SpikeChange:
            bound = np.minimum(errors[:-1] + errors[1:], min(1.0, rate + noisy))
            return SpikeChange(float(errors[-1]), float(bound.mean()))

        changes = {}
        if self.photons is not None:
            changes["photons"] = change(_poisson_error(clocks * light * self.photons) / self.photons)
        if self.dark_current:
            changes["dark_current"] = change(clocks * self.dark_current, min(1.0, light + self.dark_current))
        if self.gain_spread:
            changes["gain_spread"] = change(_MEAN_SIZE * self.gain_spread * light * clocks)
        if self.hot:
            changes["hot"] = SpikeChange(self.hot * (1 - rate) * frames, self.hot * (1 - rate))
        if self.dead:
            changes["dead"] = SpikeChange(self.dead * rate * frames, self.dead * rate)
        return changes

    def required(self, light: float, frames: int, spike_tolerance: float) -> SensorNoise:
        """Keep only the sources that may change more than a given share of the bits, see :meth:`spike_changes`.

        Args:
            light: mean light per clock, in thresholds.
            frames: clocks of the clip.
            spike_tolerance: largest share of bits that each dropped source may change.

        Returns:
            The noise without the dropped sources; a calibration is always kept.

        Raises:
            ValueError: as :meth:`spike_changes`.

        Example:
            >>> SensorNoise(photons=1e6, hot=0.01).required(light=0.2, frames=41, spike_tolerance=0.005)
            SensorNoise(photons=None, dark_current=0.0, dark_spread=0.0, gain_spread=0.0, hot=0.01, dead=0.0)
        """
        changes = self.spike_changes(light, frames)
        off = {source for source, change in changes.items() if change.share <= spike_tolerance}
        if "dark_current" in off:
            off.add("dark_spread")
        return replace(self, **{source.name: source.default for source in fields(self) if source.name in off})


def random_numbers(seed: int, purpose: str, clock: int = 0) -> np.random.Generator:
    """Return the random generator of one purpose at one clock."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_PURPOSES.index(purpose), clock)))


class NoisyPixels:
    """Pixels (*, H, W) of a sensor, with fixed-pattern and temporal noise."""

    def __init__(self, noise: SensorNoise, size: tuple[int, ...], seed: int) -> None:
        self.noise, self.size, self.seed = noise, size, seed
        known, self._gain, self._dark, self._stuck = noise.calibration, None, None, []
        if known is not None:
            check_size("light", size[-2:], known.gain.shape, " as the calibration")
            self._gain, self._dark = known.gain, known.dark
            self._stuck = [(known.defects == kind, bit) for kind, bit in ((HOT, 1), (DEAD, 0))]
            return
        if noise.gain_spread:
            self._gain = self._around_one("gain", noise.gain_spread)
        if noise.dark_current:
            self._dark = noise.dark_current * self._around_one("dark current", noise.dark_spread)
        if noise.hot or noise.dead:
            drawn = torch.from_numpy(random_numbers(seed, "defects").random(size))
            self._stuck = [(drawn < noise.hot, 1), (drawn >= 1 - noise.dead, 0)]

    def charge(self, light: Tensor, threshold: float, clock: int) -> Tensor:
        """Return the charge that pixels integrate from light (*, T, H, W) that starts at ``clock``."""
        photons = self.noise.photons
        if photons is None and self._gain is None and self._dark is None:
            return light
        charge = light.detach().to(torch.promote_types(light.dtype, torch.float32), copy=True)
        quantum = threshold / (photons or math.inf)
        gain = None if self._gain is None else self._gain.to(charge)
        dark = None if self._dark is None else self._dark * threshold
        for t, now in enumerate(charge.unbind(-3), clock):
            if photons is not None:
                now.copy_(_arrive(now, quantum, random_numbers(self.seed, "photons", t)))
            if gain is not None:
                now.mul_(gain)
            if dark is not None and photons is not None:
                now.add_(_arrive(dark, quantum, random_numbers(self.seed, "electrons", t)).to(now))
            elif dark is not None:
                now.add_(dark.to(now))
        return charge

    def spikes(self, spikes: Tensor) -> Tensor:
        """Set the spikes (*, T, H, W) of hot and dead pixels in place, and return all spikes."""
        for pixels, bit in self._stuck:
            spikes.masked_fill_(pixels.to(spikes.device).unsqueeze(-3), bit)
        return spikes

    def _around_one(self, purpose: str, spread: float) -> Tensor:
        variance = math.log1p(spread**2)  # of the logarithm
        normal = random_numbers(self.seed, purpose).standard_normal(self.size)
        return torch.from_numpy(np.exp(math.sqrt(variance) * normal - variance / 2))


def _poisson_error(means: np.ndarray) -> np.ndarray:
    """Return E|N - mean| of Poisson numbers N, in the normal approximation for large means."""
    mean = torch.from_numpy(means).double()
    most = mean.floor()
    exact = 2 * torch.exp(torch.xlogy(most + 1, mean) - mean - torch.lgamma(most + 1))
    return torch.where(mean > 1e4, _MEAN_SIZE * mean.sqrt(), exact).numpy()


def _arrive(charge: Tensor, quantum: float, numbers: np.random.Generator) -> Tensor:
    """Replace a mean charge (*, H, W) by a Poisson number of quanta; values out of range are unchanged."""
    mean = charge.double().cpu().numpy() / quantum
    known = (mean > 0) & (mean < _MOST_PHOTONS)
    counts = numbers.poisson(np.where(known, mean, 0))
    return torch.where(torch.from_numpy(known).to(charge.device), torch.from_numpy(counts * quantum).to(charge), charge)


def flicker(weights: Tensor, light: Tensor) -> Tensor:
    r"""Return the variance of weighted sums of a pixel's spikes in constant light, over all initial charges.

    In light r, an ideal pixel fires for a share r of all initial phases: an arc of the circle. The arc of the phases
    that fire d frames later is rotated by d r. The overlap of both arcs minus :math:`r^2` is the covariance of two
    spikes d frames apart.

    Args:
        weights: weights of K sums over N frames, (K, N).
        light: light in thresholds per frame, 0 to 1, (L).

    Returns:
        Variances (K, L), float32.

    Example:
        >>> flicker(torch.ones(1, 1), torch.tensor([0.0, 0.25, 0.5]))  # one spike with this probability
        tensor([[0.0000, 0.1875, 0.2500]])
    """
    weights, light = weights.double(), light.double()
    frames = weights.shape[-1]
    pairs = [(2 if apart else 1) * weights[:, : frames - apart] * weights[:, apart:] for apart in range(frames)]
    moved = torch.arange(frames, dtype=torch.float64).unsqueeze(1) * light % 1
    both = (light - moved).clamp(min=0) + (moved + light - 1).clamp(min=0)
    return (torch.stack([pair.sum(dim=1) for pair in pairs], dim=1) @ (both - light**2)).float()
