"""Settings to compare: names with arguments of ``lightning test``, the user's or the default ones."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from dataclasses import replace
from inspect import signature
from typing import NamedTuple

from lightning_modules.cli.arguments import arguments_preset, preset_arguments
from lightning_modules.cli.errors import UsageError
from lightning_modules.inference.presets import Preset
from lightning_modules.networks import Network
from lightning_modules.registry import Model, list_models
from spikekit.decoders.methods import DECODERS


class Setting(NamedTuple):
    """Arguments to be measured, and what they are called.

    Args:
        name: what it is called.
        args: arguments of ``lightning test`` that make it, behind those that all settings share.
        preset: the same as columns of a table; ``None`` where the arguments say what a preset cannot.
    """

    name: str
    args: list[str]
    preset: Preset | None = None

    @property
    def text(self) -> str:
        """As :func:`read_setting` takes it.

        Example:
            >>> Setting("small tiles", ["--tile", "32"]).text
            'small tiles: --tile 32'
        """
        typed = shlex.join(self.args)
        return typed if typed == self.name else f"{self.name}: {typed}".rstrip()


def read_setting(text: str) -> Setting:
    """Read a setting as it is typed: ``ARGS``, or ``NAME: ARGS``.

    Raises:
        UsageError: it is neither.

    Example:
        >>> read_setting("my own: -c my.yaml").args
        ['-c', 'my.yaml']
        >>> read_setting("--tile 32").name
        '--tile 32'
    """
    named = re.fullmatch(r"\s*([^-:\s][^:]*):(?:\s+(.*))?", text, re.DOTALL)
    typed = (named[2] or "") if named else text
    try:
        args = shlex.split(typed)
    except ValueError as error:
        raise UsageError(f"--setting: {text!r} cannot be read ({error})") from error
    if not named and not typed.lstrip().startswith("-"):
        expected = "expected arguments of lightning test, or a name, a colon and such arguments"
        raise UsageError(f"--setting: {expected}, as in 'small tiles: --tile 32', got {text!r}")
    return Setting(named[1].strip() if named else shlex.join(args), args, arguments_preset(args))


#: what is tried on every network: behind its name, and what it changes
_NO_MOTION, _TWO_VIEWS = ("no motion", {"motion": "ZeroFlow"}), ("self-ensemble of 2", {"self_ensemble": 2})

#: what is tried on the largest, besides: a larger network is worth more than more views of a smaller one
_MOST = [(f"self-ensemble of {views}", {"self_ensemble": views}) for views in (4, 8)]

#: what is tried on the reference, besides
_VARIANTS = [
    ("bf16-true", {"precision": "bf16-true"}),
    ("bf16-mixed", {"precision": "bf16-mixed"}),
    ("no tiles", {"tile": 0}),
    ("tiles of 64", {"tile": 64}),
    ("tolerance 0.1 dB", {"psnr_tolerance": 0.1}),
    ("tolerance 0.5 dB", {"psnr_tolerance": 0.5}),
]

_SPIKE2FLOW = {"motion": "Spike2Flow", "motion_weights": "spike2flow"}
_LEARNED = [("Spike2Flow", _SPIKE2FLOW), ("Spike2Flow, once", {**_SPIKE2FLOW, "motion_iterations": 1})]


def usual_settings(
    scale: int, own: Sequence[str] = (), network: Network | None = None, film: bool = False, frames: int = 41
) -> list[Setting]:
    """Return what is measured where nothing else is asked for.

    The networks whose weights come with the package, as they are: the reference first, then the others by their
    multiplications. Then the same without motion and as a self-ensemble, the reference faster and more exact in other
    ways, and the largest as larger self-ensembles; then the decoders without learning.

    Args:
        scale: super-resolution factor.
        own: arguments that give weights to the network of all settings, such as ``--ckpt_path``: that network then
            stands in the place of those in the package.
        network: that network, of which only what it has arguments for is changed.
        film: pictures of films are measured: those of all networks, for films or not, as they are and without motion.
        frames: spike frames of the scenes; networks of longer clips are left out.
    """
    # Noisy sensors would need other scenes; a network for films is another's equal on one clip.
    models = [one for one in list_models(scale) if not one.noise and one.film <= film and one.frames <= frames]
    models.sort(key=lambda model: model.macs)
    largest = models[-1].name if models else None
    reference = _reference(models) if models else None
    networks = {one.name: Preset(one.name) for one in sorted(models, key=lambda one: one is not reference)}
    if own:
        networks, largest = {"own weights": Preset()}, "own weights"
    lacking: set[str] = set()
    if network is not None:
        lacking = {"motion"} - signature(type(network)).parameters.keys()
        if network.halo is None:  # it is never cut into tiles
            lacking |= {"tile", "psnr_tolerance"}
    presets = dict(networks)
    for place, (weights, preset) in enumerate(networks.items()):
        more = [_TWO_VIEWS, *(_MOST if weights == largest else []), *([*_LEARNED, *_VARIANTS] if place == 0 else [])]
        fixed = {"motion"} if preset.network else set()
        for name, changes in [_NO_MOTION, *([] if film else more)]:
            if not (lacking | fixed) & changes.keys():
                presets[f"{weights}, {name}"] = replace(preset, **changes)
    usual = {"frames": 41} if frames > 41 else {}  # of a picture by a decoder, whatever a network sees
    decoders = {
        name: Preset(network="ClassicalDecoder", scale=scale, method=method, **usual, **options)
        for method, decoder in DECODERS.items()
        for name, options in decoder.shown.items()
    }
    if usual:  # in little light a decoder, too, gains by what it sees of a longer clip
        window = 2 * ((frames - 1) // 6) + 1
        longer = Preset(network="ClassicalDecoder", scale=scale, method="tfp", window=window, order=3, frames=frames)
        decoders[f"TFP {window}, order 3"] = longer
    without = [word for option in own for word in (option, "null")]  # decoders take no weights
    return [Setting(name, preset_arguments(preset), preset) for name, preset in presets.items()] + [
        Setting(name, [*preset_arguments(preset), *without], preset) for name, preset in decoders.items()
    ]


def _reference(models: Sequence[Model]) -> Model:
    """Return what ratios refer to and is tried in more ways than the others: of a middle size, for a short clip."""
    short = min(one.frames for one in models)
    single = [one for one in models if one.frames == short and not one.film]
    return single[(len(single) - 1) // 2]
