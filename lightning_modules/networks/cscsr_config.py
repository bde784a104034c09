"""Configuration of CSCSR, a frozen dataclass."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, get_args, get_origin, get_type_hints

from lightning_modules.networks.sizes import SIZES, default_stride
from spikekit.check import check_positive, check_whole
from spikekit.color.cfa import GREY, cfa_pattern


@dataclass(frozen=True)
class CSCSRConfig:
    """Configuration of a :class:`lightning_modules.networks.CSCSR`: a YAML file fills it, and weights carry it.

    The paper leaves widths and depths open: a ``size`` of this project gives those that are not given. The fields from
    ``representation`` to ``reconstruction`` are the ablations of the paper's Table 3, see ``configs/ablation``; the
    defaults are the full network (J).

    Args:
        scale: super-resolution factor s.
        frames: spike frames N of a clip, odd.
        window: spike frames that a time point sees, odd.
        stride: spike frames between two time points; must divide frames - window. When not given, that of the size, or
            what gives eleven time points: 3 for 41 frames, 9 for 101.
        pattern: Bayer phase of the streams; ``"grey"`` where all pixels see the same: there is one colour then.
        size: a name of :data:`lightning_modules.networks.sizes.SIZES`, for what is not given of ``stride``, the widths
            and depths up to ``end_width``, and ``resolution``. Weights carry the values, not the name.
        width: channels of refinement and reconstruction.
        representation_width: channels of the spike representation, at sensor resolution.
        features: channels of every time point that are warped.
        stages: fusions of the colours.
        blocks: residual blocks of every colour before every fusion.
        end_blocks: residual blocks after the last fusion.
        end_width: channels after the last fusion; when neither the size gives them, ``width``.
        skip: learn what to add to a smooth, enlarged TFP picture instead of the picture itself. The paper has no
            such skip; with it training starts where the classical decoder ends. The picture of a grey sensor, which
            has nothing to demosaic, is the widest mean of third order that the clip has room for, and not smooth.
        alpha: gain of the camera, what a white pixel receives per clock in thresholds, of clips that come without one:
            the picture is light, divided by it. Weights trained with another are adapted when they are loaded.
        noise: whether the network is told how noisy the sensor is.
        neighbors: known pixels that the temporal pixel search weighs.
        representation: features of a time point: ``"bssr"`` learns them; ``"spikes"``, without BSSR (A), averages the
            spikes of the window; ``"interval"`` (C) takes the inverse of the spike interval. These two have no weights
            and one feature.
        global_perception: BSSR sees the whole clip beside the window; False is B.
        motion_fusion: where no flow is given, ``"joint"`` moves all colours alike; ``"independent"`` (D) moves each
            by the flow of its own sub-stream, green by the mean of its two; ``"assembled"`` (E) puts the sub-streams'
            flows together as their pixels are in the Bayer pattern.
        search: temporal pixel search along the motion. Without it no motion is estimated, a given one is ignored, and
            the features of every time point are only enlarged; without refinement as well it is F, no MSR.
        refinement: FR; False is G, which merges the time points by one convolution.
        reconstruction: ``"correlated"`` is CCR; ``"separate"`` (H) lets every colour make its channel by itself;
            ``"early"`` (I) fuses the colours once, at the beginning.
        resolution: where refinement and reconstruction work. ``"output"`` is that of the picture, as in the paper;
            ``"sensor"`` that of the sensor, with the s x s temporal pixels of a site as channels and a sub-pixel
            convolution at the end: the same width then costs 1 / s^2 of the work.

    Raises:
        ValueError: sizes that do not fit each other, an unknown choice, or choices that would have no effect:
            ``global_perception=False`` without BSSR, a ``motion_fusion`` without search, an ``end_width`` of separate
            colours; ``noise`` without BSSR or correlated colours; another ``motion_fusion`` or ``reconstruction`` than
            the default of a single colour.

    Example:
        >>> CSCSRConfig(scale=2).times
        (5, 8, 11, 14, 17, 20, 23, 26, 29, 32, 35)
    """

    scale: int = 4
    frames: int = 41
    window: int = 11
    stride: int | None = None
    pattern: str = "RGGB"
    size: str = "full_base"
    width: int | None = None
    representation_width: int | None = None
    features: int | None = None
    stages: int | None = None
    blocks: int | None = None
    end_blocks: int | None = None
    end_width: int | None = None
    skip: bool = False
    alpha: float = 0.4
    noise: bool = False
    neighbors: int = 4
    representation: Literal["bssr", "spikes", "interval"] = "bssr"
    global_perception: bool = True
    motion_fusion: Literal["joint", "independent", "assembled"] = "joint"
    search: bool = True
    refinement: bool = True
    reconstruction: Literal["correlated", "separate", "early"] = "correlated"
    resolution: Literal["output", "sensor"] | None = None

    def __post_init__(self) -> None:
        if self.size not in SIZES:
            raise ValueError(f"size: expected one of {', '.join(SIZES)}, got {self.size!r}")
        for name, value in SIZES[self.size].items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)  # frozen
        _check_fields(self)
        if self.stride is None:
            object.__setattr__(self, "stride", default_stride(self.frames, self.window))
        frames, window, stride = self.frames, self.window, self.stride
        if frames % 2 == 0 or window % 2 == 0 or window >= frames or (frames - window) % stride:
            raise ValueError(
                "frames, window, stride: expected odd frames and window, and a stride that divides frames - window, "
                f"got {frames}, {window}, {stride}"
            )
        if self.representation != "bssr" and not self.global_perception:
            raise ValueError(
                f"global_perception: part of representation bssr, cannot be taken from {self.representation}"
            )
        if self.motion_fusion != "joint" and not self.search:
            raise ValueError(
                f"motion_fusion: expected joint without search, which asks for no motion, got {self.motion_fusion}"
            )
        if self.noise and (self.representation, self.reconstruction) != ("bssr", "correlated"):
            got = f"{self.representation} and {self.reconstruction}"
            raise ValueError(f"noise: expected representation bssr and reconstruction correlated with it, got {got}")
        if self.pattern == GREY and (self.motion_fusion, self.reconstruction) != ("joint", "correlated"):
            got = f"{self.motion_fusion} and {self.reconstruction}"
            raise ValueError(
                f"motion_fusion, reconstruction: expected joint and correlated for the one colour of grey, got {got}"
            )
        if self.end_width is not None and self.reconstruction == "separate":
            raise ValueError(f"end_width: separate colours are never fused, expected none, got {self.end_width}")

    @property
    def settings(self) -> dict[str, Any]:
        """Return the values of all fields but the name of the size, from which the same network is built again."""
        return {name: value for name, value in asdict(self).items() if name != "size"}

    @property
    def times(self) -> tuple[int, ...]:
        """Centres of the windows, in spike frames."""
        return tuple(range(self.window // 2, self.frames - self.window // 2, self.stride))


def _check_fields(config: Any) -> None:
    """Check every field of a dataclass by its type, and write whole numbers as Python's own.

    ``int`` is a whole number, 1 or more; ``float`` a finite number above 0; a field called ``pattern`` a Bayer phase,
    or ``"grey"``. A field that may be None is checked where it is not.
    """
    hints = get_type_hints(type(config))
    for field in fields(config):
        name, value, hint = field.name, getattr(config, field.name), hints[field.name]
        if type(None) in get_args(hint):
            if value is None:
                continue
            hint = next(kind for kind in get_args(hint) if kind is not type(None))
        if hint is int:
            value = check_whole(name, value)
        elif hint is float:
            check_positive(name, value)
        elif hint is bool and not isinstance(value, bool):
            raise ValueError(f"{name}: expected true or false, got {value!r}")
        elif get_origin(hint) is Literal and value not in get_args(hint):
            raise ValueError(f"{name}: expected one of {', '.join(get_args(hint))}, got {value!r}")
        elif name == "pattern":
            value = cfa_pattern(value)
        object.__setattr__(config, name, value)  # frozen
