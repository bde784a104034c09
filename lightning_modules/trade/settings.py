"""Settings to compare, given by the user or by default: names with arguments of ``lightning test``."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from typing import NamedTuple

from lightning_modules.cli.errors import UsageError
from lightning_modules.inference.presets import Preset
from lightning_modules.networks import Network
from lightning_modules.registry import Model, for_noise, list_models

#: columns of a table, by option
_COLUMNS = {f"--model.network.{name}": name for name in ("method", "window", "order", "scale", "frames")}
_COLUMNS |= {f"--{name}": name for name in ("tile", "self_ensemble")}
_COLUMNS |= {"--model.weights": "weights", "--model.network": "network", "--trainer.precision": "precision"}


class Setting(NamedTuple):
    """Name of a setting, and its arguments of ``lightning test``, which are appended to the shared ones."""

    name: str
    args: list[str]

    @property
    def preset(self) -> Preset | None:
        """The setting as a preset; ``None`` if it has arguments that a preset lacks.

        Example:
            >>> Setting("small", ["--model.weights=cscsr_small_x4"]).preset.weights
            'cscsr_small_x4'
            >>> Setting("mine", ["--config", "my.yaml"]).preset
        """
        words = [part for word in self.args for part in (word.split("=", 1) if word.startswith("--") else [word])]
        given = {_COLUMNS.get(option): value for option, value in zip(words[::2], words[1::2], strict=False)}
        own_network = given.get("network", "ClassicalDecoder") != "ClassicalDecoder"
        if None in given or 2 * len(given) != len(words) or own_network:
            return None
        try:
            return Preset.read(given)
        except ValueError:
            return None


def read_setting(text: str) -> Setting:
    """Parse a setting: ``ARGS`` or ``NAME: ARGS``.

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
        raise UsageError(f"--setting: {text!r} cannot be parsed ({error})") from error
    if not named and not typed.lstrip().startswith("-"):
        expected = "expected arguments of lightning test, or a name, a colon and such arguments"
        raise UsageError(f"--setting: {expected}, as in 'small tiles: --tile 32', got {text!r}")
    return Setting(named[1].strip() if named else shlex.join(args), args)


#: options of the decoders in the table
_DECODERS = {"TFI": {}, "TFP 41": {"window": 41}, "TFP 13, order 3": {"window": 13, "order": 3}}

#: variants with more views: two for every network, up to four without motion, as the next network is several times
#: slower, and up to eight for the largest
_VIEWS = {views: (f"self-ensemble of {views}", f"--self_ensemble {views}") for views in (2, 4, 8)}

#: further variants of the reference
_VARIANTS = [
    ("32-true", "--trainer.precision 32-true"),
    ("no tiles", "--tile 0"),
    ("tiles of 64", "--tile 64"),
]


def usual_settings(
    scale: int,
    own: Sequence[str] = (),
    network: Network | None = None,
    film: bool = False,
    frames: int = 41,
    pattern: str = "RGGB",
) -> list[Setting]:
    """Return the default settings.

    First the networks of the package: the reference, then the others by their multiplications. Then variants: every
    network as a self-ensemble, the reference also in float32 and with other tiles, the largest network and those
    without motion also with larger self-ensembles. Last the classical decoders. For films, of the variants only the
    self-ensembles of networks without motion.

    If ``own`` options, such as ``--ckpt_path``, give weights to the shared ``network``, it replaces those of the
    package, and variants that it has no options for are left out.
    """
    noisy = {name for ideal, name in for_noise(scale).items() if ideal != name}  # they would need other scenes
    models = [one for one in list_models(scale, pattern) if one.name not in noisy and one.frames <= frames]
    models.sort(key=lambda model: model.macs)
    largest, quick = models[-1].name if models else None, [one.name for one in models if not one.search]
    reference = _reference(models) if models else None
    networks = {one.name: f"--model.weights {one.name}" for one in sorted(models, key=lambda one: one is not reference)}
    if own:
        networks, largest = {"own weights": ""}, "own weights"
    in_tiles = network is None or network.halo is not None
    typed = dict(networks)
    for place, (weights, text) in enumerate(networks.items()):
        most = 8 if weights == largest else 4 if weights in quick else 2
        more = [variant for views, variant in _VIEWS.items() if views <= most]
        if film:
            more = more if weights in quick else []
        elif place == 0:
            more += _VARIANTS
        for name, changes in more:
            if in_tiles or not changes.startswith("--tile"):
                typed[f"{weights}, {name}"] = f"{text} {changes}"
    without = " ".join(f"{option} null" for option in own)  # decoders take no weights
    for name, options in _DECODERS.items():
        options = {"method": name[:3].lower(), "scale": scale, "frames": min(frames, 41), **options}
        given = " ".join(f"--model.network.{option} {value}" for option, value in options.items())
        typed[name] = f"--model.network ClassicalDecoder {given} {without}"
    return [Setting(name, text.split()) for name, text in typed.items()]


def _reference(models: Sequence[Model]) -> Model:
    """Return the reference of the ratios, which also gets most variants: of medium size, with motion, short clips."""
    short = min(one.frames for one in models)
    those = [one for one in models if one.search and one.frames == short]
    return those[(len(those) - 1) // 2]
