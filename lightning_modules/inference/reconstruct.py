"""Reconstruct the pictures of a recording in one call."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lightning_modules.inference.clips import FRAMES, NOISY, RecordingClips, film_groups
from lightning_modules.inference.film import FilmFrame, FilmMaker
from lightning_modules.inference.predict import precision_of
from lightning_modules.inference.presets import SPEEDS, Conditions, Preset, choose
from lightning_modules.networks import ClassicalDecoder, Network
from spikekit import __version__, correct_spikes
from spikekit.arguments import one_line
from spikekit.check import check_positive
from spikekit.color.cfa import GREY, PATTERNS
from spikekit.io.images import to_bytes
from spikekit.recording import Recording, open_recording

# width of the white gap between two pictures side by side, in pixels
_GAP = 4


def reconstruct(
    path: str | Path,
    speed: str | None = None,
    *,
    budget: str | None = None,
    network: Network | str | Path | None = None,
    scale: int | None = None,
    height: int | None = None,
    width: int | None = None,
    flip: bool = False,
    pattern: str | None = None,
    camera: str | None = None,
    calibration: str | None = None,
    frame: str | None = None,
    white: float | None = None,
    device: str | torch.device | None = None,
    precision: str | None = None,
    **how: Any,
) -> Reconstruction:
    """Reconstruct the pictures of a recording.

    Convention:
        Without a ``network``, ``speed`` or ``budget`` chooses weights of the package whose clips fit the recording.
        Unless the sensor was calibrated in the dark or the recording is simulated, dead and hot pixels are filled from
        a neighbour, and the noise is measured; if it is strong, the weights are those trained for noisy sensors.
        ``calibration="none"`` declares the pixels ideal. In dim light, clips are longer, see
        :meth:`lightning_modules.inference.clips.RecordingClips.in_light`.

        Films of ``"fast"`` and ``"balanced"`` run the network only where something moves, and less often where it is
        slow; ``psnr_tolerance=0`` runs it everywhere.

    Args:
        path: a ``.dat`` or ``.npz`` file, see :func:`spikekit.read_spikes`.
        speed: ``"best"``, ``"balanced"`` (default), ``"fast"`` or ``"fastest"``, see
            :func:`lightning_modules.inference.presets.choose`.
        budget: in place of ``speed``, the largest time or memory per picture, such as ``"40ms"`` or ``"200MB"``.
        network: in place of ``speed``, a network, the name of weights of the package, or the path of a weights file.
        scale: super-resolution factor for ``speed`` and ``budget``; default 4, or 1 for a grey camera.
        height: rows of a frame; needed for a ``.dat`` file without side-car or camera, as it has no header.
        width: columns of a frame; needed in the same case.
        flip: turn the stored frames upside down, as real cameras need.
        pattern: Bayer phase after the flip, or ``"grey"`` for a camera without colours, whose pictures are grey.
            Default: the phase of the side-car or the camera, else RGGB.
        camera: camera that made the recording, one of :data:`spikekit.CAMERAS` or a ``.json`` file; sets ``height``,
            ``width``, ``flip``, ``pattern`` and the gamma of the pictures.
        calibration: calibration file of ``spikekit calibrate``; the spikes are corrected to those of an ideal sensor.
            Default: NAME.calibration.safetensors beside the recording.
        frame: spike frames to show: N, or A to B - 1 as A:B or A:B:STEP; STEP is 20 by default.
        white: white level in spikes per frame; smaller values give brighter pictures. Default: that of the side-car,
            else what 99.9 % of the pixels do not exceed at any time, the same in all pictures.
        device: device of the network; default: a GPU if there is one.
        precision: ``"32-true"`` or ``"bf16-mixed"``; default: the latter if the device computes in bfloat16.
        how: ``tile``, ``psnr_tolerance``, ``self_ensemble`` and ``future`` of
            :class:`lightning_modules.inference.film.FilmMaker`; they override those of the chosen preset.

    Returns:
        The pictures, computed on demand: iterate over them, or call :meth:`Reconstruction.array`.

    Raises:
        spikekit.SpikeFileError: the file cannot be read.
        FileNotFoundError: the weights do not exist.
        ValueError: the recording is shorter than a clip, or an argument is out of range.

    Example:
        >>> import tempfile, torch
        >>> from spikekit import write_spikes
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_spikes(f"{folder}/clip.npz", torch.rand(61, 8, 10) < 0.3)
        ...     pictures = reconstruct(f"{folder}/clip.npz", "fastest")
        ...     [clock for clock, rgb in pictures], pictures.array().shape
        ([20, 40], (2, 32, 40, 3))
    """
    given = [value for value in (speed, budget, network) if value is not None]
    if len(given) > 1:
        raise ValueError(f"speed, budget, network: expected one of them, got {', '.join(map(str, given))}")
    recording = open_recording(
        path, height=height, width=width, flip=flip, pattern=pattern, camera=camera, calibration=calibration
    )
    notes: list[str] = []
    if not (network is None or isinstance(network, Network)):
        network = Network.from_pretrained(network)
    if network is not None and scale not in (None, network.settings["scale"]):
        raise ValueError(f"scale: expected {network.settings['scale']}, that of the network, got {scale}")
    looks = RecordingClips(recording, FRAMES if network is None else network.frames)
    level = looks.noise_level
    white = looks.white if white is None else white
    check_positive("white", white)
    if network is None:
        scale = (1 if recording.pattern == GREY else 4) if scale is None else scale
        speed = "balanced" if budget is None and speed is None else speed
        preset, notes = _chosen(recording, speed, budget, scale, frame)
        how = {**preset.given("tile", "self_ensemble"), **how}
        if speed in ("fast", "balanced") and not how.get("future"):
            how = {"psnr_tolerance": 0.1, **how}
        network = preset.build(GREY if recording.pattern == GREY else "RGGB")
    clips = RecordingClips(recording, network.frames, frame, network.pattern).in_light(white, join=network.joins)
    network.noise_level = level * clips.joined**0.5
    light = f"dim light: {clips.joined} spike frames are joined into one" if clips.joined > 1 else ""
    notes = [line for line in (recording.note, other_sensor(recording, network.pattern), *notes, light) if line]
    return Reconstruction(network, clips, white, device, precision, notes, **how)


class Reconstruction:
    """Pictures of a recording, computed on demand.

    Iterating yields them in order, as :class:`lightning_modules.inference.film.FilmFrame`.

    Args:
        network: network of :mod:`lightning_modules.networks`.
        clips: clips of the recording, of the length that the network takes.
        white: white level in spikes per frame; measured by default.
        device: device of the network, see :func:`reconstruct`.
        precision: ``"32-true"`` or ``"bf16-mixed"``, see :func:`reconstruct`.
        notes: lines that explain the choice of the network.
        how: options of :class:`lightning_modules.inference.film.FilmMaker`.

    Attributes:
        notes: lines that explain the choice of the network.
    """

    def __init__(
        self,
        network: Network,
        clips: RecordingClips,
        white: float | None = None,
        device: str | torch.device | None = None,
        precision: str | None = None,
        notes: list[str] | None = None,
        **how: Any,
    ) -> None:
        if precision not in (None, "32-true", "bf16-mixed"):
            raise ValueError(f"precision: expected 32-true or bf16-mixed, got {precision!r}")
        try:
            self.device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
            torch.empty(0, device=self.device)
        except (AssertionError, RuntimeError) as error:
            raise ValueError(f"device: expected one of this machine, got {device} ({one_line(error)[:80]})") from error
        self.precision = precision or precision_of(self.device)
        self.network = network.to(self.device).eval()
        self.clips, self.notes, self.how = clips, notes or [], how
        FilmMaker(network, **how)  # reports wrong arguments at once
        self.white = clips.white if white is None else white

    def __len__(self) -> int:
        return len(self.clips)

    def __iter__(self) -> Iterator[FilmFrame]:
        return self.pictures()

    def pictures(
        self,
        made: Collection[int] = (),
        part: tuple[int, int] = (0, 1),
        beside: str | None = None,
        state: Path | None = None,
    ) -> Iterator[FilmFrame]:
        """Yield the pictures that do not exist yet.

        Args:
            made: spike frames whose pictures exist.
            part: index of the part of the recording, from 0, and number of parts.
            beside: decoder, ``"tfi"`` or ``"tfp"``, whose picture of the same clip is put to the left of every picture.
            state: file for what later pictures of a film depend on, from which a stopped run continues.
        """
        maker = FilmMaker(self.network, **self.how)
        maker.calibration = self.clips.calibration
        joined = self.clips.joined
        exposure = self.network.settings["alpha"] / (joined * self.white)
        groups = self._groups(maker, set(made), *part)
        if state is not None:
            first = next((group[0] for group, wanted in groups if wanted), 0)
            last = maker.load(state, first, self.device)
            groups = [one for one in groups if one[0][0] > last]
        clips = self.clips.in_order((frame for group, _ in groups for frame in group), raw=True)
        mixed = torch.autocast(self.device.type, torch.bfloat16, enabled=self.precision == "bf16-mixed")
        for n, (group, wanted) in enumerate(groups, 1):
            spikes = torch.stack([clip for _, clip in islice(clips, len(group))]).to(self.device)
            with torch.inference_mode(), mixed:
                rgb = maker(spikes, [frame / joined for frame in group], exposure=exposure).float()
            for frame, clip, picture in zip(group, spikes, rgb, strict=True):
                if wanted and frame not in made:
                    shown = self._shown(picture.cpu().clone())
                    yield FilmFrame(frame, torch.cat([*self._decoded(clip, beside), shown], dim=-1))
            if state is not None and maker.warm_up and n % -(-maker.warm_up // len(group)) == 0:
                maker.save(state, group[-1])

    def _groups(self, maker: FilmMaker, made: set[int], part: int, parts: int) -> list[tuple[list[int], bool]]:
        """Groups of frames made together, and whether their pictures are wanted or they only warm up the network."""
        chosen = self.clips.chosen
        every = min((later - frame for frame, later in pairwise(chosen)), default=1)
        size = maker.together(every / self.clips.joined)
        groups = list(film_groups(chosen, maker.future + 1, size))
        mine = range(*(len(groups) * n // parts for n in (part, part + 1)))
        wanted = {n for n in mine if not made.issuperset(groups[n])}
        before = -(-maker.warm_up // size)
        seen = sorted({n for last in wanted for n in range(max(last - before, 0), last + 1)})
        return [(groups[n], n in wanted) for n in seen]

    def _shown(self, rgb: Tensor) -> Tensor:
        """Return light (3, H, W) in [0, 1], white being 1, as the camera displays it."""
        recording = self.clips.recording
        if recording.pattern == GREY and len(rgb) == 3:
            rgb = (rgb * rgb.new_tensor([0.25, 0.5, 0.25])[:, None, None]).sum(0, keepdim=True)
        return recording.show(rgb.expand(3, -1, -1), known=False)

    def _decoded(self, clip: Tensor, method: str | None) -> list[Tensor]:
        """Return a decoder's picture of a clip (N, H, W), and a white gap."""
        if method is None:
            return []
        settings = self.network.settings
        decoder = ClassicalDecoder(method, settings["scale"], settings["pattern"], self.white * self.clips.joined)
        clip = correct_spikes(clip.cpu(), self.clips.calibration, self.network.pattern)
        rgb = self._shown(decoder(clip[None])[0].clamp(0, 1))
        return [rgb, rgb.new_ones(3, rgb.shape[1], _GAP)]

    def array(self) -> np.ndarray:
        """Return all pictures, (K, s H, s W, 3), uint8."""
        return np.stack([to_bytes(rgb).numpy() for _, rgb in self])

    def identity(self) -> dict[str, Any]:
        """Return everything that the pictures depend on, as plain values."""
        recording, clips = self.clips.recording, self.clips
        path, stat = recording.path.resolve(), recording.path.stat()
        measured = recording.calibration and sorted(vars(recording.calibration).items())
        return {
            "recording": [str(path), stat.st_size, stat.st_mtime_ns],
            "read": [recording.stored, recording.flip, recording.pattern, clips.top, clips.left, recording.camera],
            "clip": [clips.frames, clips.joined],
            "calibration": measured and _digest((name, value) for name, value in measured),
            "ideal": recording.ideal,
            "white": self.white,
            "network": [type(self.network).__name__, self.network.settings, _digest(self.network.state_dict().items())],
            "motion": str(getattr(self.network, "motion", None)),
            "how": self.how,
            "precision": self.precision,
            "version": __version__,
        }


def other_sensor(recording: Recording, pattern: str) -> str | None:
    """Return a warning if the camera is grey and the weights are for colour, or the reverse."""
    if recording.pattern == GREY and pattern != GREY:
        return f"the camera is grey, but the weights are for {pattern}: they take texture for colour"
    if recording.pattern in PATTERNS and pattern == GREY:
        return f"the camera is {recording.pattern}, but the weights are for grey: they take its mosaic for texture"
    return None


def _digest(values: Any) -> str:
    """Return a hash of named tensors or values."""
    total = hashlib.sha256()
    for name, value in values:
        total.update(name.encode())
        if isinstance(value, Tensor):
            value = value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy()
        else:
            value = str(value).encode()
        total.update(value)
    return total.hexdigest()


def _chosen(
    recording: Recording,
    speed: str | None,
    budget: str | None,
    scale: int,
    frame: str | None,
) -> tuple[Preset, list[str]]:
    """Return the preset for a speed or a budget, and lines that tell its name and cost."""
    clips = RecordingClips(recording, frame=frame)
    every = min((later - clock for clock, later in pairwise(clips.chosen)), default=clips.frames + 1)
    film = every <= clips.frames  # neighbouring clips overlap
    noisy, grey = clips.noise_level > NOISY, recording.pattern == GREY
    conditions = Conditions(scale, clips.size, film, clips.room, noisy, grey)
    choice = choose(conditions, speed, budget)
    said = [str(choice)]
    if speed not in (None, "fastest"):
        sooner = list(SPEEDS)[list(SPEEDS).index(speed) - 1]
        other = choose(conditions, sooner)
        said += [f"faster, --speed {sooner}: {other}"] if other != choice else []
    if noisy and choice.preset.weights:
        said.append(_uncalibrated(clips))
    return choice.preset, said


def _uncalibrated(clips: RecordingClips) -> str:
    """Return a line on the weights used for a noisy sensor without calibration."""
    level = f"noise level {clips.noise_level:.1f}"
    small = "the picture is too small, too dark or too textured to measure noise"
    said = f"{small}, {level} is assumed" if clips.gain_spread is None else f"{level} is measured"
    dark = ", with a recording in the dark," if clips.recording.calibration is not None else ""
    return (
        f"this sensor is not calibrated; {said}: using weights trained for noisy sensors; spikekit calibrate{dark} "
        "measures the pixels, --calibration none takes them for ideal"
    )
