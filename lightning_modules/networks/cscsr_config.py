"""Configuration of CSCSR."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, get_args, get_origin, get_type_hints

from lightning_modules.networks.sizes import SIZES, default_stride
from spikekit.check import check_positive, check_whole
from spikekit.color.cfa import GREY, cfa_pattern


@dataclass(frozen=True)
class CSCSRConfig:
    """Configuration of a :class:`lightning_modules.networks.CSCSR`, set in YAML files and stored with weights.

    The paper does not specify widths and depths; the preset ``size`` sets those that are not given. The fields from
    ``representation`` to ``reconstruction`` select the ablations A to I of the paper's Table 3, see
    ``configs/ablation``; the defaults are the full network (J).

    Args:
        scale: super-resolution factor s.
        frames: number N of spike frames per clip, odd.
        window: number of spike frames per time point, odd.
        stride: spike frames between two time points; must divide frames - window. Default: that of the size, or the
            stride for eleven time points: 3 for 41 frames, 9 for 101.
        pattern: Bayer phase of the sensor, or ``"grey"`` for a sensor without colour filters.
        size: preset of ``stride``, the widths and depths up to ``end_width``, and ``resolution``, such as ``"small"``;
            see :data:`lightning_modules.networks.sizes.SIZES`. Weights store the values, not the name.
        width: channels of refinement and reconstruction.
        representation_width: channels of the spike representation, at sensor resolution.
        features: feature channels per time point.
        stages: number of colour fusions.
        blocks: residual blocks per colour before each fusion.
        end_blocks: residual blocks after the last fusion.
        end_width: channels after the last fusion. Default: that of the size, or ``width``.
        skip: predict a residual, which is added to a smooth, enlarged TFP picture, so that training starts from the
            result of the classical decoder. The paper has no such skip. For a grey sensor, the picture is third-order
            TFP with the largest window that fits in the clip, without smoothing.
        alpha: default gain of the camera: light of a white pixel per clock, in thresholds. The picture is light divided
            by alpha. Weights trained with another alpha are adapted when they are loaded.
        noise: condition the network on the noise level of the sensor.
        noise_blocks: residual blocks that correct the features after the last fusion by the noise level. They run only
            for a noisy sensor, and can be trained alone. Default: the level changes gain and shift of features.
        neighbors: number of known pixels in the weighted mean of the temporal pixel search.
        representation: features of a time point. ``"bssr"`` learns them; ``"spikes"`` (A, without BSSR) averages the
            spikes of the window; ``"interval"`` (C) inverts the spike interval. A and C have one feature and no
            weights.
        global_perception: BSSR also sees the whole clip; False is B.
        motion_fusion: motion of the colours when no flow is given. ``"joint"`` uses one flow for all colours;
            ``"independent"`` (D) one per colour, from its own sub-stream, with the mean of two for green;
            ``"assembled"`` (E) interleaves the flows of the sub-streams as in the Bayer pattern.
        search: temporal pixel search along the motion. False ignores motion and only enlarges the features of each
            time point to the resolution of the reconstruction; with ``refinement=False`` it is F, no MSR.
        refinement: feature refinement FR; False is G, one convolution over all time points.
        reconstruction: ``"correlated"`` is CCR; ``"separate"`` (H) reconstructs each colour channel independently;
            ``"early"`` (I) fuses the colours once, at the beginning.
        resolution: resolution of refinement and reconstruction. ``"output"`` is that of the picture, as in the paper;
            ``"sensor"`` has s x s temporal pixels per sensor pixel as channels and ends with a sub-pixel convolution,
            for 1 / s^2 of the work at the same width. ``"cell"`` has all spikes of 2 x 2 sensor pixels as channels, and
            neither representation nor search nor refinement: only ``width`` and ``end_blocks`` count. It always
            predicts a residual, as with ``skip``.

    Raises:
        ValueError: values are inconsistent or unknown, or options have no effect together:
            ``global_perception=False`` without BSSR, ``motion_fusion`` without search, ``end_width`` with separate
            colours, ``noise`` without BSSR and correlated colours, ``noise_blocks`` without ``noise``,
            ``motion_fusion`` or ``reconstruction`` with a grey sensor, parts that resolution ``"cell"`` lacks.

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
    noise_blocks: int | None = None
    neighbors: int = 4
    representation: Literal["bssr", "spikes", "interval"] = "bssr"
    global_perception: bool = True
    motion_fusion: Literal["joint", "independent", "assembled"] = "joint"
    search: bool = True
    refinement: bool = True
    reconstruction: Literal["correlated", "separate", "early"] = "correlated"
    resolution: Literal["output", "sensor", "cell"] | None = None

    def __post_init__(self) -> None:
        if self.size not in SIZES:
            raise ValueError(f"size: expected one of {', '.join(SIZES)}, got {self.size!r}")
        for name, value in SIZES[self.size].items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)  # frozen
        _check_fields(self)
        if self.resolution == "cell":
            if (self.representation, self.reconstruction, self.noise_blocks) != ("bssr", "correlated", None):
                got = f"{self.representation}, {self.reconstruction} and {self.noise_blocks}"
                raise ValueError(
                    "representation, reconstruction, noise_blocks: expected bssr, correlated and None for resolution "
                    f"cell, which has none of them, got {got}"
                )
            object.__setattr__(self, "search", False)
        if self.stride is None:
            object.__setattr__(self, "stride", default_stride(self.frames, self.window))
        frames, window, stride = self.frames, self.window, self.stride
        if frames % 2 == 0 or window % 2 == 0 or window >= frames or (frames - window) % stride:
            expected = "expected odd frames and window, and a stride that divides frames - window"
            raise ValueError(f"frames, window, stride: {expected}, got {frames}, {window}, {stride}")
        if self.representation != "bssr" and not self.global_perception:
            raise ValueError(f"global_perception: expected true for representation {self.representation}, got false")
        if self.motion_fusion != "joint" and not self.search:
            expected = "expected joint, as motion has no effect without search"
            raise ValueError(f"motion_fusion: {expected}, got {self.motion_fusion}")
        if self.noise and (self.representation, self.reconstruction) != ("bssr", "correlated"):
            got = f"{self.representation} and {self.reconstruction}"
            raise ValueError(f"noise: expected representation bssr and reconstruction correlated, got {got}")
        if self.noise_blocks and not self.noise:
            raise ValueError(f"noise_blocks: expected None without noise, got {self.noise_blocks}")
        if self.pattern == GREY and (self.motion_fusion, self.reconstruction) != ("joint", "correlated"):
            expected = "expected joint and correlated for a grey sensor"
            got = f"{self.motion_fusion} and {self.reconstruction}"
            raise ValueError(f"motion_fusion, reconstruction: {expected}, got {got}")
        if self.end_width is not None and self.reconstruction == "separate":
            raise ValueError(f"end_width: expected None, as separate colours are never fused, got {self.end_width}")

    @property
    def settings(self) -> dict[str, Any]:
        """Return all fields except ``size``; they define the same network."""
        return {name: value for name, value in asdict(self).items() if name != "size"}

    @property
    def times(self) -> tuple[int, ...]:
        """Centres of the windows, in spike frames."""
        return tuple(range(self.window // 2, self.frames - self.window // 2, self.stride))


def _check_fields(config: Any) -> None:
    """Check every field of a dataclass by its type, and convert integers to Python's int.

    An ``int`` must be positive, a ``float`` finite and positive, a field named ``pattern`` a Bayer phase or ``"grey"``.
    Fields that are None are not checked.
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
