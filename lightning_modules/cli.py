"""The ``lightning`` command: LightningCLI with one output folder, and with checkpoints that are found again."""

from __future__ import annotations

import argparse
import logging
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jsonargparse import ArgumentParser
from pytorch_lightning import Callback, LightningDataModule, LightningModule, Trainer
from pytorch_lightning.callbacks import LearningRateMonitor, ModelCheckpoint
from pytorch_lightning.cli import LightningArgumentParser, LightningCLI
from pytorch_lightning.loggers import TensorBoardLogger

from lightning_modules.arguments import WEIGHTS, behind_configurations, flatten, options, with_network_of_weights
from lightning_modules.callbacks import PredictionPictures
from lightning_modules.data import FilmScenes, Recording, StillScenes
from lightning_modules.flow_training import FlowTraining
from lightning_modules.learner import Learner
from lightning_modules.module import SuperResolution
from lightning_modules.motion import Spike2Flow
from lightning_modules.networks import CSCSR
from lightning_modules.pretrained import CheckpointMismatchError, check_settings, read_weights, write_weights
from lightning_modules.speed import SPEEDS, choose
from spikekit import SpikeFileError, spikes_shape

#: classes whose arguments ``--help`` lists, by the option that names them
CHOICES = (
    ("model", SuperResolution),
    ("model.network", CSCSR),
    ("model", FlowTraining),
    ("model.network", Spike2Flow),
    ("data", StillScenes),
    ("data", FilmScenes),
    ("data", Recording),
)

_NO_RECORDING = "predict: expected a recording: --data Recording --data.path FILE"

_LOADERS = {
    "fit": "train_dataloader",
    "validate": "val_dataloader",
    "test": "test_dataloader",
    "predict": "predict_dataloader",
}


class InputError(ValueError):
    """Something that the user gave and that cannot be used; shown as one line."""


class Parser(LightningArgumentParser):
    """A parser whose help also lists the arguments of the classes that a configuration may name."""

    def format_help(self) -> str:  # noqa: D102
        text = super().format_help()
        if any(action.dest == "model" for action in self._actions):
            for option, choice in CHOICES:
                parser = ArgumentParser(add_help=False, usage=argparse.SUPPRESS)
                parser.add_class_arguments(choice, option)
                text += f"\nwith --{option} {choice.__name__}:\n\n{parser.format_help()}"
        elif "{fit," in text:
            text += "    sweep               Train and test every combination of overlays, values and seeds.\n"
            text += "    trade               Measure what every setting costs and what it is worth.\n"
            text += "    export              Write the weights of a checkpoint as safetensors.\n"
        return text


def _with_choice(parser: LightningArgumentParser, args: Sequence[str]) -> list[str]:
    """Put in the setting that ``--speed`` or ``--budget`` asks for, and say which."""
    given = next((option for _, option, _ in options(args) if option in (*WEIGHTS, "--ckpt_path")), None)
    if given:
        raise InputError(f"--speed and --budget: choose from the weights of the package, got {given} as well")
    verb, *rest = args
    parsed = parser.parse_args([verb, "--config", '{"model": {"network": {"class_path": "CSCSR"}}}', *rest])[verb]
    recording = parsed.data.get("init_args", {})
    if not recording.get("path"):
        raise InputError(_NO_RECORDING)
    try:
        size = spikes_shape(*(recording.get(name) for name in ("path", "height", "width")))[1:]
        choice = choose(parsed.model.init_args.network.init_args.scale, parsed.speed, parsed.budget, size)
    except (OSError, ValueError) as error:
        raise InputError(str(error)) from error
    print(choice, flush=True)
    return behind_configurations(args, choice.args)


class Command(LightningCLI):
    """The ``lightning`` command."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:  # noqa: D102
        parser.add_argument(
            "-o",
            "--output",
            type=str,
            default="runs",
            help="Folder of the run: checkpoints, TensorBoard files, config.yaml, tables and pictures.",
        )
        parser.set_defaults({"model": {"class_path": "SuperResolution"}})
        network = "model.init_args.network.init_args"
        for name in ("scale", "frames", "alpha"):
            parser.link_arguments(f"{network}.{name}", f"data.init_args.{name}")
        parser.link_arguments(f"{network}.pattern", "data.init_args.crop_to")
        parser.link_arguments(
            (f"{network}.frames", f"{network}.window"),
            "data.init_args.flow_times",
            lambda frames, window: (window // 2, frames - 1 - window // 2),
        )

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:  # noqa: D102
        args = sys.argv[1:] if args is None else list(args)
        if any(option in ("--speed", "--budget") for _, option, _ in options(args)):
            args = _with_choice(parser, args)
        try:
            args = with_network_of_weights(args)
        except (OSError, ValueError) as error:
            raise InputError(str(error)) from error
        self.config = parser.parse_args(args)

    def _prepare_subcommand_parser(self, klass: type, subcommand: str, **kwargs: Any) -> LightningArgumentParser:
        parser = super()._prepare_subcommand_parser(klass, subcommand, **kwargs)
        if subcommand == "predict":
            parser.add_argument(
                "--speed",
                choices=list(SPEEDS),
                help="Weights of the package and how they are used: the best; the fastest at most 0.2 dB (balanced) or "
                "1 dB (fast) below it, as measured by lightning trade; the fastest.",
            )
            parser.add_argument(
                "--budget",
                help="Instead, what a frame may take, such as 40ms or 200MB: the best that fits, by the same table.",
            )
        return parser

    def before_instantiate_classes(self) -> None:
        """Turn ``--ckpt_path best`` and ``last`` into files, and keep a run from being written over."""
        config = self.config[self.subcommand]
        check_folder(config.output)
        checkpoints = Path(config.output) / "checkpoints"
        asked = config.get("ckpt_path")
        if asked in ("best", "last"):
            config.ckpt_path = str(checkpoints / f"{asked}.ckpt")
        if asked and not Path(config.ckpt_path).is_file():
            raise InputError(f"{config.ckpt_path}: no such checkpoint")
        if self.subcommand == "fit" and not asked and not config.trainer.fast_dev_run and any(checkpoints.glob("*")):
            raise InputError(f"{checkpoints}: holds a run already; --ckpt_path last goes on with it, -o goes elsewhere")

    def instantiate_classes(self) -> None:  # noqa: D102
        config = self.config[self.subcommand]
        if self.subcommand == "fit":
            _check_trainer(config.trainer)
        try:
            super().instantiate_classes()
            # here, so that what is wrong with it is known before anything is written
            _check_verb(self.subcommand, self.model, self.datamodule)
            self.datamodule.setup(self.subcommand)
            _check_agreement(self.model, self.datamodule)
            if self.subcommand == "fit":
                chosen = self.config_dump["model"]["init_args"]
                self.model.recipe = {name: chosen.get(name) for name in ("optimizer", "lr_scheduler")}
                if config.ckpt_path:
                    _check_continuation(config.ckpt_path, self.model)
        except (OSError, ValueError) as error:
            # jsonargparse wraps what a class of a class says into pages about its own types
            said = re.search(r"^ *- (?!Does not validate|Expected a )(.*)$", str(error), re.MULTILINE)
            raise InputError(said[1] if said else str(error)) from error

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Send everything to one folder, and use bfloat16 on a GPU that has it."""
        output = Path(self._get(self.config_init, "output"))
        config = self._get(self.config_init, "trainer")
        kwargs["default_root_dir"] = output
        kwargs["callbacks"] = [*(config.get("callbacks") or []), *self._callbacks(output)]
        if config.get("logger") is None:
            # the tables and pictures of the other commands are files of their own
            kwargs["logger"] = TensorBoardLogger(output, name="", version="") if self.subcommand == "fit" else False
        if config.get("precision") is None:
            kwargs["precision"] = _precision(config.get("accelerator"))
        if self.subcommand != "fit":
            self.save_config_callback = None  # config.yaml is the record of the training
        return super().instantiate_trainer(**kwargs)

    def _callbacks(self, output: Path) -> list[Callback]:
        if self.subcommand == "fit":
            monitor, mode = self.model.best
            folder = {"dirpath": output / "checkpoints", "enable_version_counter": False}
            logs = self._get(self.config_init, "trainer").get("logger") not in (False, [])
            return [
                ModelCheckpoint(filename="best", monitor=monitor, mode=mode, **folder),
                ModelCheckpoint(filename="last", save_on_train_epoch_end=True, **folder),
                *([LearningRateMonitor()] if logs else []),
                self.model.pictures(),
            ]
        if self.subcommand == "test":
            return [self.model.report(output)]
        return [PredictionPictures(output)] if self.subcommand == "predict" else []


def check_folder(output: str | Path) -> None:
    """Refuse what cannot be made a folder.

    Raises:
        InputError: it is a file, or inside one.
    """
    there = next(path for path in (Path(output).absolute(), *Path(output).absolute().parents) if path.exists())
    if not there.is_dir():
        raise InputError(f"-o: expected a folder, got the file {there}")


def _check_trainer(trainer: Any) -> None:
    """Settings of Lightning that would leave a run without what the other commands need."""
    if trainer.enable_checkpointing is False:
        raise InputError("trainer.enable_checkpointing: expected true, checkpoints are what fit is for, got false")
    if trainer.limit_val_batches == 0:
        raise InputError("trainer.limit_val_batches: expected more than 0, validation chooses best.ckpt, got 0")


def _check_verb(verb: str, model: Learner, data: LightningDataModule) -> None:
    if verb == "predict" and type(model).predict_step is LightningModule.predict_step:
        raise InputError(f"predict: expected a model that makes pictures, got {type(model).__name__}")
    loader = _LOADERS[verb]
    if getattr(type(data), loader) is getattr(LightningDataModule, loader):
        scenes = f"{verb}: expected scenes whose truth is known, got {type(data).__name__}"
        raise InputError(_NO_RECORDING if verb == "predict" else scenes)
    if verb == "fit" and not any(parameter.requires_grad for parameter in model.network.parameters()):
        raise InputError(f"fit: expected a network that learns, got {type(model.network).__name__}")


def _check_continuation(path: str, model: Learner) -> None:
    """Refuse to go on with another network, optimizer or schedule: the checkpoint's would win without a word."""
    checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    check_settings(model.network, checkpoint.get("network", {}), "the checkpoint")
    here = dict(flatten(model.recipe))
    there = dict(flatten(checkpoint.get("recipe") or model.recipe))  # older checkpoints do not say
    for key in sorted({**there, **here}):
        if there.get(key) != here.get(key):
            name, expected = key.replace(".init_args", ""), f"{there.get(key)}, as {path} was trained with"
            anew = "--model.weights starts anew with other settings"
            raise InputError(f"model.{name}: expected {expected}, got {here.get(key)}; {anew}")


def _check_agreement(model: Learner, data: LightningDataModule) -> None:
    """What is not linked, because more than one kind of model has it; a recording has a Bayer phase of its own."""
    if not isinstance(data, (StillScenes, FilmScenes)):
        return
    if data.workers < 0:
        raise ValueError(f"data.workers: expected 0 or more, got {data.workers}")
    for name, expected in model.needs.items():
        got = data.options[name]
        if got != expected:
            raise ValueError(f"data.{name}: expected {expected}, as the model has it, got {got}")


def _precision(accelerator: str) -> str:
    wanted = accelerator in ("auto", "gpu", "cuda") and torch.cuda.is_available() and torch.cuda.is_bf16_supported()
    return "bf16-mixed" if wanted else "32-true"


def main(args: Sequence[str] | None = None, command: type[Command] = Command) -> None:
    """Run the ``lightning`` command.

    Args:
        args: what was typed after ``lightning``; ``sys.argv`` when not given.
        command: what runs it.
    """
    logging.getLogger("pytorch_lightning.utilities.rank_zero").addFilter(lambda line: "litlogger" not in line.msg)
    verb, *rest = (sys.argv[1:] if args is None else args) or [""]
    try:
        if verb == "sweep":
            from lightning_modules.sweep.cli import sweep

            sweep(rest)
        elif verb == "trade":
            from lightning_modules.trade.cli import trade

            trade(rest)
        elif verb == "export":
            export(rest)
        else:
            run(args, command)
    except (InputError, SpikeFileError, CheckpointMismatchError) as error:
        sys.exit(f"lightning: {error}")


def export(args: Sequence[str]) -> None:
    """Write the weights of a checkpoint as a file of safetensors.

    Args:
        args: what was typed after ``lightning export``.

    Raises:
        InputError: no such checkpoint, or a damaged one; or a name of another kind of file.
    """
    parser = argparse.ArgumentParser(
        prog="lightning export",
        description="Write the weights of a checkpoint as a file of safetensors that knows what network it is of, for "
        "lightning predict --model.weights FILE and CSCSR.from_pretrained(FILE).",
    )
    parser.add_argument("checkpoint", help="checkpoint of lightning fit")
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help="name.safetensors")
    asked = parser.parse_args(args)
    try:
        write_weights(read_weights(asked.checkpoint), asked.output)
    except (OSError, ValueError) as error:
        raise InputError(str(error)) from error
    print(f"{asked.output}: {Path(asked.output).stat().st_size / 2**20:.1f} MiB")


def run(args: Sequence[str] | None, command: type[Command]) -> Command:
    """Run what was typed after ``lightning``, with one of Lightning's verbs; what is wrong with it is raised."""
    return command(
        Learner,
        LightningDataModule,
        subclass_mode_model=True,
        subclass_mode_data=True,
        auto_configure_optimizers=False,
        parser_class=Parser,
        save_config_kwargs={"overwrite": True},
        args=None if args is None else list(args),
    )
