"""What is traded: settings, each a name and arguments of ``lightning test``; those of the user, or the usual ones."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from typing import NamedTuple

from lightning_modules.cli import InputError
from lightning_modules.pretrained import shipped_weights


class Setting(NamedTuple):
    """One row of the table.

    Args:
        name: what it is called.
        args: arguments of ``lightning test`` that make it, behind those that all settings share.
    """

    name: str
    args: list[str]

    @property
    def text(self) -> str:
        """As :func:`read_setting` takes it.

        Example:
            >>> Setting("small tiles", ["--model.tile", "32"]).text
            'small tiles: --model.tile 32'
        """
        typed = shlex.join(self.args)
        return typed if typed == self.name else f"{self.name}: {typed}".rstrip()


def read_setting(text: str) -> Setting:
    """Read a setting as it is typed: ``ARGS``, or ``NAME: ARGS``.

    Raises:
        InputError: it is neither.

    Example:
        >>> read_setting("my own: -c my.yaml").args
        ['-c', 'my.yaml']
        >>> read_setting("--model.tile 32").name
        '--model.tile 32'
    """
    named = re.fullmatch(r"\s*([^-:\s][^:]*):(?:\s+(.*))?", text, re.DOTALL)
    typed = (named[2] or "") if named else text
    try:
        args = shlex.split(typed)
    except ValueError as error:
        raise InputError(f"--setting: {text!r} cannot be read ({error})") from error
    if not named and not typed.lstrip().startswith("-"):
        expected = "expected arguments of lightning test, or a name, a colon and such arguments"
        raise InputError(f"--setting: {expected}, as in 'small tiles: --model.tile 32', got {text!r}")
    return Setting(named[1].strip() if named else shlex.join(args), args)


#: what is tried on every network: behind its name, and behind its arguments
_EFFORT = [("no motion", "--model.network.motion ZeroFlow"), ("self-ensemble of 2", "--model.self_ensemble 2")]

#: what is tried on the largest, besides: a larger network is worth more than more views of a smaller one
_MOST = [(f"self-ensemble of {views}", f"--model.self_ensemble {views}") for views in (4, 8)]

#: what is tried on the first, besides
_VARIANTS = [
    ("exact search", "--model.network.steps 0"),
    ("search steps 4", "--model.network.steps 4"),
    ("bf16-true", "--trainer.precision bf16-true"),
    ("bf16-mixed", "--trainer.precision bf16-mixed"),
    ("no tiles", "--model.tile 0"),
    ("tiles of 64", "--model.tile 64"),
    ("tolerance 0.1 dB", "--model.tolerance 0.1"),
    ("tolerance 0.5 dB", "--model.tolerance 0.5"),
]  # fmt: skip

_SPIKE2FLOW = "--model.network.motion Spike2Flow --model.network.motion.weights spike2flow"
_LEARNED = [("Spike2Flow", _SPIKE2FLOW), ("Spike2Flow, once", f"{_SPIKE2FLOW} --model.network.motion.iterations 1")]

_DECODER = "--model.network ClassicalDecoder --model.network.method"
_DECODERS = [
    ("TFP 41", f"{_DECODER} tfp --model.network.window 41"),
    ("TFP 13, order 3", f"{_DECODER} tfp --model.network.window 13 --model.network.order 3"),
    ("TFI", f"{_DECODER} tfi"),
]


def usual_settings(scale: int, own: Sequence[str] = ()) -> list[Setting]:
    """Return what is measured where nothing else is asked for.

    The networks whose weights come with the package, as they are; then the same without motion and as a self-ensemble,
    the first of them faster and more exact in other ways, and the largest as larger self-ensembles; then the decoders
    without learning.

    Args:
        scale: super-resolution factor.
        own: arguments that give weights to the network of all settings, such as ``--ckpt_path``: that network then
            stands in the place of those in the package.
    """
    shipped = shipped_weights()
    names = [name for name in shipped if name.startswith(f"x{scale}-")]
    networks = [Setting(name, ["--model.weights", name]) for name in names]
    largest = max(names, key=lambda name: shipped[name].stat().st_size, default=None)
    if own:
        networks, largest = [Setting("own weights", [])], "own weights"
    learned = _LEARNED if "spike2flow" in shipped else []
    variants = [
        Setting(f"{network.name}, {name}", [*network.args, *shlex.split(args)])
        for place, network in enumerate(networks)
        for name, args in [
            *(learned if place == 0 else []),
            *_EFFORT,
            *(_MOST if network.name == largest else []),
            *(_VARIANTS if place == 0 else []),
        ]
    ]
    # weights know their scale, decoders are told it: the arguments of a row are to serve without the configuration
    rest = ["--model.network.scale", str(scale), *(word for option in own for word in (option, "null"))]
    return networks + variants + [Setting(name, [*shlex.split(args), *rest]) for name, args in _DECODERS]
