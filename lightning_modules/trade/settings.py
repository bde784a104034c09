"""Settings to compare: names with arguments of ``lightning test``, the user's or the default ones."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from inspect import signature
from typing import NamedTuple

from lightning_modules.cli.errors import UsageError
from lightning_modules.inference.presets import Preset
from lightning_modules.networks import Network
from lightning_modules.registry import Model, list_models

#: columns of a table, by the options that say the same
_COLUMNS = {f"--model.network.{name}": name for name in ("method", "window", "order", "scale", "frames", "motion")}
_COLUMNS |= {f"--model.network.motion.{name}": f"motion_{name}" for name in ("weights", "iterations")}
_COLUMNS |= {f"--{name}": name for name in ("tile", "self_ensemble", "interpolated")}
_COLUMNS |= {"--model.weights": "weights", "--model.network": "network", "--trainer.precision": "precision"}


class Setting(NamedTuple):
    """What a setting is called, and the arguments of ``lightning test`` that make it, behind those that all share."""

    name: str
    args: list[str]

    @property
    def preset(self) -> Preset | None:
        """The same as columns of a table; ``None`` where the arguments say what a preset cannot.

        Example:
            >>> Setting("small", ["--model.weights=cscsr_small_x4"]).preset.weights
            'cscsr_small_x4'
            >>> Setting("mine", ["--config", "my.yaml"]).preset
        """
        words = [part for word in self.args for part in (word.split("=", 1) if word.startswith("--") else [word])]
        given = {_COLUMNS.get(option): value for option, value in zip(words[::2], words[1::2], strict=False)}
        if (
            None in given
            or 2 * len(given) != len(words)
            or given.get("network", "ClassicalDecoder") != "ClassicalDecoder"
        ):
            return None
        try:
            return Preset.read(given)
        except ValueError:
            return None


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
    return Setting(named[1].strip() if named else shlex.join(args), args)


#: options of the decoders that stand beside the networks
_DECODERS = {"TFI": {}, "TFP 41": {"window": 41}, "TFP 13, order 3": {"window": 13, "order": 3}}

#: what is tried on every network: behind its name, and what is typed for it
_NO_MOTION, _TWO_VIEWS = ("no motion", "--model.network.motion ZeroFlow"), ("self-ensemble of 2", "--self_ensemble 2")

#: what is tried on the largest, besides: a larger network is worth more than more views of a smaller one
_MOST = [(f"self-ensemble of {views}", f"--self_ensemble {views}") for views in (4, 8)]

#: what is tried on the reference, besides
_SPIKE2FLOW = "--model.network.motion Spike2Flow --model.network.motion.weights spike2flow"
_VARIANTS = [
    ("Spike2Flow", _SPIKE2FLOW),
    ("Spike2Flow, once", f"{_SPIKE2FLOW} --model.network.motion.iterations 1"),
    ("bf16-true", "--trainer.precision bf16-true"),
    ("bf16-mixed", "--trainer.precision bf16-mixed"),
    ("no tiles", "--tile 0"),
    ("tiles of 64", "--tile 64"),
]


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
        film: pictures of films are measured, as they are and without motion.
        frames: spike frames of the scenes; networks of longer clips are left out.
    """
    # noisy sensors would need other scenes
    models = [one for one in list_models(scale) if not one.noise and one.frames <= frames]
    models.sort(key=lambda model: model.macs)
    largest = models[-1].name if models else None
    reference = _reference(models) if models else None
    networks = {one.name: f"--model.weights {one.name}" for one in sorted(models, key=lambda one: one is not reference)}
    if own:
        networks, largest = {"own weights": ""}, "own weights"
    lacking: tuple[str, ...] = ()
    if network is not None and "motion" not in signature(type(network)).parameters:
        lacking += ("--model.network.motion",)
    if network is not None and network.halo is None:  # it is never cut into tiles
        lacking += ("--tile",)
    typed = dict(networks)
    for place, (weights, text) in enumerate(networks.items()):
        more = [_TWO_VIEWS, *(_MOST if weights == largest else []), *(_VARIANTS if place == 0 else [])]
        for name, changes in [_NO_MOTION, *([] if film else more)]:
            if not changes.startswith(lacking):
                typed[f"{weights}, {name}"] = f"{text} {changes}"
    decoders = {
        name: {"method": name[:3].lower(), "scale": scale, **({"frames": 41} if frames > 41 else {}), **options}
        for name, options in _DECODERS.items()
    }
    if frames > 41:  # in little light a decoder, too, gains by what it sees of a longer clip
        window = 2 * ((frames - 1) // 6) + 1
        longer = {"method": "tfp", "scale": scale, "window": window, "order": 3, "frames": frames}
        decoders[f"TFP {window}, order 3"] = longer
    without = " ".join(f"{option} null" for option in own)  # decoders take no weights
    for name, options in decoders.items():
        given = " ".join(f"--model.network.{option} {value}" for option, value in options.items())
        typed[name] = f"--model.network ClassicalDecoder {given} {without}"
    return [Setting(name, text.split()) for name, text in typed.items()]


def _reference(models: Sequence[Model]) -> Model:
    """Return what ratios refer to and is tried in more ways than the others: of a middle size, for a short clip."""
    short = min(one.frames for one in models)
    those = [one for one in models if one.frames == short]
    return those[(len(those) - 1) // 2]
