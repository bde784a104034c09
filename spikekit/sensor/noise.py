"""Noise of a real sensor: photon noise, dark current, fixed-pattern noise, hot and dead pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from spikekit.check import check_whole

# Each has its own random numbers. The place in the list tells them apart: append, never reorder.
_PURPOSES = ("charge", "gain", "dark current", "defects", "photons", "electrons")

_MEAN_SIZE = math.sqrt(2 / math.pi)  # E|x| of a standard normal x
# A pixel that leaks a threshold fires at every clock; of pixels that differ more, nearly all would see nothing.
_MOST = {"dark_current": 1.0, "dark_spread": 10.0, "gain_spread": 10.0, "hot": 1.0, "dead": 1.0}
_MOST_PHOTONS = 1e18  # NumPy's Poisson numbers end at 9.2e18, and one photon more or less is no longer seen here


#: What ``defects`` of a measured sensor hold: the pixel works, does not see light, or fires whatever the light is.
WORKS, DEAD, HOT = 0, 1, 2


class MeasuredPixels(Protocol):
    """What noise reads of a sensor that was measured, such as a :class:`spikekit.Calibration`; all (H, W)."""

    gain: Tensor
    dark: Tensor
    defects: Tensor

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""


class SpikeChange(NamedTuple):
    """How much one source of noise changes, see :meth:`SensorNoise.spike_changes`.

    Args:
        charge: mean size of the error of a pixel's charge at the end of the clip, in thresholds: by how many spikes
            its count is off.
        share: the share of the stream's bits that differ, at most.
    """

    charge: float
    share: float


@dataclass(frozen=True)
class SensorNoise:
    r"""Noise of a real sensor; every source is off unless it is asked for.

    .. math:: I'_t = \theta \, (g \, P_t + D_t), \quad
        P_t \sim \operatorname{Poisson}(p I_t / \theta) / p, \quad
        D_t \sim \operatorname{Poisson}(p \, d) / p, \quad
        \mathrm{E} g = 1, \; \sigma(g) = \sigma_g, \quad \mathrm{E} d = \bar d, \; \sigma(d) = \sigma_d \bar d

    Convention:
        :math:`I_t` is the light of a pixel at a clock, :math:`\theta` the threshold, :math:`I'_t` the charge that the
        pixel integrates. Charges are counted in thresholds, so that a setting means the same at every threshold.
        Without ``photons``, light and dark current arrive evenly: :math:`P_t = I_t / \theta`, :math:`D_t = d`.

        Gain g and dark current d are a pixel's own and stay as they are. They are log-normal: hardly to be told from
        normal for a spread of some per cent, but above 0 and with the mean that was asked for, however wide.

        A hot pixel fires at every clock, as one does whose leak fills a threshold each time; a dead one never fires.
        No pixel is both. With a larger share, the same pixels fail and others with them.

        Light below 0 has no photons and stays as it is, so do NaN and infinity.

        Every source has random numbers of its own, drawn from the seed, and those in time anew for every clock. So
        one source switched on or off changes nothing about the others, and neither does a cut between two clocks.
        They are drawn on the CPU, and are the same wherever the light is.

    Args:
        photons: p, electrons that make one threshold, at least 1; ``None`` for no photon noise.
        dark_current: :math:`\bar d`, mean charge that leaks in per clock, in thresholds, at most 1.
        dark_spread: :math:`\sigma_d`, standard deviation of the dark current between pixels, relative to its mean, at
            most 10.
        gain_spread: :math:`\sigma_g`, standard deviation of the gain between pixels, at most 10: fixed-pattern noise.
        hot: share of pixels that always fire.
        dead: share of pixels that never fire.
        calibration: gain, dark current and defects of a sensor that was measured, a :class:`spikekit.Calibration`,
            instead of random ones; then the spreads and shares above are 0.

    Raises:
        ValueError: a number out of its range, shares of hot and dead pixels that together exceed 1, a spread of a dark
            current of 0, a calibration beside one of the options that it replaces.

    Example:
        The constants of Hu et al. for a camera of 250 x 400 pixels at 20 kHz, which are bare numbers, read as fF, V and
        pA: a threshold is a charge of 4.35 fF x 1.09 V or 30 000 electrons; 0.44 pA of dark current, with a standard
        deviation of 39 %, make 0.0047 of it in a clock; the gains of pixels spread by 6 %:

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
            raise ValueError(f"hot, dead: expected shares that add up to 1 at most, got {self.hot}, {self.dead}")
        if self.dark_spread and not self.dark_current:
            raise ValueError(f"dark_spread: expected a dark_current above 0 with it, got {self.dark_spread} of none")
        drawn = [name for name in ("dark_current", "gain_spread", "hot", "dead") if getattr(self, name)]
        if self.calibration is not None and drawn:
            raise ValueError(f"{drawn[0]}: expected 0, as the calibration has it, got {getattr(self, drawn[0])}")

    def spike_changes(self, light: float, frames: int) -> dict[str, SpikeChange]:
        r"""Tell how much each source that is on changes a clip, without simulating it.

        .. math:: \text{share} \le \frac{1}{T} \sum_{t=1}^{T} \min(\mathrm{E}|E_{t-1}| + \mathrm{E}|E_t|, \;
            r + r', \; 1)

        Convention:
            Let :math:`E_t` be the charge that the source has added to a pixel up to clock t. Without it, the pixel
            fires at clock t if a multiple of the threshold lies in :math:`(Q_{t-1}, Q_t]`, with the source, if one
            lies in :math:`(Q_{t-1} + E_{t-1}, Q_t + E_t]`. The bits can only differ if one lies between the
            beginnings or between the ends, and as the charge begins uniform in [0, threshold), whatever the light,
            that has the probabilities :math:`\min(1, |E_{t-1}|)` and :math:`\min(1, |E_t|)`. Nor can more bits differ
            than are set with (:math:`r'`) and without (:math:`r`) the source. In light that does not change, the bound
            is nearly reached until the errors become as large as the light of one clock or what it lacks of a
            threshold.

            Mean errors, in thresholds: that of a Poisson number for photons, :math:`\sqrt{2 t I / \pi p}` where many
            arrive; :math:`t \bar d` for dark current; at most :math:`\sqrt{2 / \pi} \, t I \sigma_g` for gains. Hot
            pixels change :math:`1 - I` of their bits and dead ones I, with errors of :math:`(1 - I) T` and
            :math:`I T`.

            The mean over pixels may stand for light that differs from pixel to pixel, below the threshold. The
            shares of several sources together add up to a bound of what all of them change.

        Args:
            light: mean light per clock, in thresholds.
            frames: T, clocks of the clip.

        Returns:
            One :class:`SpikeChange` for every source that is on, by the name of its field; ``dark_spread`` goes with
            ``dark_current``. A calibration is not judged, and always stays.

        Raises:
            ValueError: light that is negative or not finite, frames below 1.
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
        """Leave only the sources that may change more than a share of the bits, see :meth:`spike_changes`.

        What is left out changes at most ``spike_tolerance`` of the bits each.

        Args:
            light: mean light per clock, in thresholds.
            frames: clocks of the clip.
            spike_tolerance: the share.

        Returns:
            This noise without the rest.

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
    """Return the random numbers of one purpose at one clock; they depend on nothing else."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_PURPOSES.index(purpose), clock)))


class NoisyPixels:
    """The pixels (*, H, W) of one sensor: their fixed pattern, and the noise of every clock."""

    def __init__(self, noise: SensorNoise, size: tuple[int, ...], seed: int) -> None:
        if noise.calibration is not None and noise.calibration.size != tuple(size[-2:]):
            expected, got = noise.calibration.size, tuple(size[-2:])
            raise ValueError(
                f"light: expected {expected[0]} x {expected[1]} of the calibration, got {got[0]} x {got[1]}"
            )
        self.noise, self.size, self.seed = noise, size, seed
        known, self._gain, self._dark, self._stuck = noise.calibration, None, None, []
        if known is not None:
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
        """Return the charge that pixels integrate from light (*, T, H, W), whose first frame is that of ``clock``."""
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
        """Set the bits (*, T, H, W) of hot and dead pixels, in place, and return all of them."""
        for pixels, bit in self._stuck:
            spikes.masked_fill_(pixels.to(spikes.device).unsqueeze(-3), bit)
        return spikes

    def _around_one(self, purpose: str, spread: float) -> Tensor:
        variance = math.log1p(spread**2)  # of the logarithm
        normal = random_numbers(self.seed, purpose).standard_normal(self.size)
        return torch.from_numpy(np.exp(math.sqrt(variance) * normal - variance / 2))


def _poisson_error(means: np.ndarray) -> np.ndarray:
    """E|N - mean| of Poisson numbers N; where they are large, that of normal ones."""

    def error(mean: float) -> float:
        if mean > 1e4:
            return _MEAN_SIZE * math.sqrt(mean)
        most = math.floor(mean)
        return 2 * math.exp((most + 1) * math.log(mean) - mean - math.lgamma(most + 1)) if mean else 0.0

    return np.array([error(mean) for mean in means.tolist()])


def _arrive(charge: Tensor, quantum: float, numbers: np.random.Generator) -> Tensor:
    """Let a mean charge (*, H, W) arrive in whole quanta; what has no number of quanta stays as it is."""
    mean = charge.double().cpu().numpy() / quantum
    known = (mean > 0) & (mean < _MOST_PHOTONS)
    counts = numbers.poisson(np.where(known, mean, 0))
    return torch.where(torch.from_numpy(known).to(charge.device), torch.from_numpy(counts * quantum).to(charge), charge)
