"""Runners: settings that are built as by ``lightning test`` and run as by ``lightning predict``."""

from __future__ import annotations

import logging
from argparse import ArgumentError
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import torch
from pytorch_lightning.utilities.exceptions import MisconfigurationException
from torch import Tensor

from lightning_modules.cli.command import Rehearsal, resolved, run
from lightning_modules.cli.errors import InputError, UsageError, VerbParser, causes
from lightning_modules.cli.reasons import reason
from lightning_modules.inference.film import FilmFrame, FilmMaker, film
from lightning_modules.inference.predict import precision_of
from lightning_modules.storage.pretrained import load_weights, read_weights
from lightning_modules.tasks.super_resolution import SuperResolution
from spikekit.arguments import one_line, whole

# data options without effect on test clips; and frames, as shorter networks take the middle of the shared clips
_WITHOUT_EFFECT = ("patch", "train_clips", "batch_size", "workers", "frames", "flow_times")


class CannotRunError(RuntimeError):
    """A valid setting that cannot run here."""


class _Test(Rehearsal):
    precision_on = staticmethod(precision_of)  # as lightning predict

    def instantiate_trainer(self, **kwargs: Any) -> Any:
        trainer = super().instantiate_trainer(**kwargs)
        asked = self.config[self.verb].trainer.precision
        if asked == "16-mixed" and trainer.precision != asked:  # Lightning only warns
            raise MisconfigurationException(f"{asked}: not on this device, Lightning uses {trainer.precision} instead")
        return trainer


class Runner:
    """A network with its precision and device, and the ``data`` and ``config`` of its test.

    Args:
        args: arguments of ``lightning test``, and these of ``lightning predict``: ``--tile``, ``--tolerance``,
            ``--self_ensemble`` and ``--future``.
    """

    def __init__(self, args: Sequence[str]) -> None:
        how, args = _how().parse_known_args(args)
        logging.disable(logging.INFO)  # Lightning would describe the machine for every setting
        try:
            command = _built(args)
        finally:
            logging.disable(logging.NOTSET)
        trainer, module = command.trainer, command.model
        if not isinstance(module, SuperResolution):
            raise UsageError(f"expected a model that makes pictures, got {type(module).__name__}")
        self.config = resolved(command)
        self.data = command.datamodule
        self.device = trainer.strategy.root_device
        self.precision = trainer.precision_plugin
        self.network = self.precision.convert_module(module).to(self.device).eval().network
        self.how = {name: value for name, value in vars(how).items() if value is not None}
        try:
            self._maker()  # reports wrong options at once
        except ValueError as error:
            raise UsageError(str(error)) from error

    @property
    def scenes(self) -> dict[str, Any]:
        """Data arguments that determine the test scenes."""
        data = self.config["data"]
        arguments = {key: value for key, value in data["init_args"].items() if key not in _WITHOUT_EFFECT}
        linked = {name: self.network.settings[name] for name in ("scale", "alpha")}
        return {"class": data["class_path"], **arguments, **linked}

    def __call__(self, spikes: Tensor) -> Tensor:
        """Return the picture of ``lightning predict`` for a clip: rgb (1, 3, s H, s W), in [0, 1].

        If the spikes (1, N, H, W), on the device, have more frames than the network takes, the middle ones are used.
        """
        first = (spikes.shape[1] - self.network.frames) // 2
        clip = spikes[:, first : first + self.network.frames]
        with torch.inference_mode(), self.precision.predict_step_context():
            return self._maker()(self.precision.convert_input(clip), [0])

    def _maker(self) -> FilmMaker:
        return FilmMaker(self.network, **self.how)

    def film(self, chunks: Iterable[Tensor], every: int) -> Iterator[FilmFrame]:
        """Yield the pictures of a film of spikes (T, H, W), see :func:`lightning_modules.inference.film.film`."""
        chunks, white = map(self.precision.convert_input, chunks), self.network.settings["alpha"]
        with torch.inference_mode(), self.precision.predict_step_context():
            yield from film(self.network, chunks, every, white=white, **self.how)


def _how() -> VerbParser:
    """Return a parser of the options of a setting that ``lightning predict`` has as well."""
    parser = VerbParser(prog="lightning trade", add_help=False, allow_abbrev=False)
    for name in ("tile", "self_ensemble", "future"):
        parser.add_argument(f"--{name}", type=whole(0))
    parser.add_argument("--tolerance", type=float, dest="psnr_tolerance")
    return parser


def make_runner(shared: Sequence[str], args: Sequence[str], base: Runner) -> Runner:
    """Build a setting and check that its test scenes are those of ``base``, which all settings share."""
    runner = Runner([*shared, *args])
    if runner.scenes != base.scenes:
        key = next(key for key in base.scenes if runner.scenes.get(key) != base.scenes[key])
        got = f"got {runner.scenes.get(key)}; options of the scenes belong outside --setting"
        raise UsageError(f"data.{key}: expected {base.scenes[key]}, the same scenes for all, {got}")
    frames = base.network.frames
    if runner.network.frames > frames:
        raise UsageError(f"frames: expected at most the {frames} of the clips, got {runner.network.frames}")
    return runner


def _built(args: Sequence[str]) -> _Test:
    try:
        command = run(["test", *args], _Test)
        path = command.config[command.verb].ckpt_path
        if path:
            load_weights(command.model.network, read_weights(path))
    except ArgumentError as error:
        raise UsageError(reason(str(error))) from error
    except MisconfigurationException as error:
        raise CannotRunError(one_line(error)) from error
    except ValueError as error:
        wrong = UsageError if isinstance(error, UsageError) else InputError
        kind = CannotRunError if any(isinstance(cause, OSError) for cause in causes(error)) else wrong
        raise kind(str(error)) from error
    return command
