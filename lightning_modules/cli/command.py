"""The ``lightning`` command: LightningCLI with one output folder, in which it finds its checkpoints again."""

from __future__ import annotations

import argparse
import logging
import os
import sys
import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from inspect import signature
from mimetypes import guess_type
from pathlib import Path
from time import perf_counter
from typing import Any, NoReturn

import torch
import yaml
from jsonargparse import ArgumentParser
from pytorch_lightning import Callback, LightningDataModule, LightningModule, Trainer
from pytorch_lightning.callbacks import LearningRateMonitor, ModelCheckpoint
from pytorch_lightning.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from pytorch_lightning.loggers import TensorBoardLogger
from pytorch_lightning.utilities import rank_zero_only
from pytorch_lightning.utilities.exceptions import MisconfigurationException

from lightning_modules.cli import prediction
from lightning_modules.cli.arguments import classes_first, flatten, options, whole_counts, with_network_of_weights
from lightning_modules.cli.errors import InputError, UsageError
from lightning_modules.cli.folder_lock import FolderError, locked_folder, make_folder
from lightning_modules.cli.prediction import NO_RECORDING
from lightning_modules.cli.processes import make_parts
from lightning_modules.cli.reasons import reason, suggestion, unknown
from lightning_modules.cli.renamed_overlays import with_current_overlays
from lightning_modules.data import FilmScenes, Recording, StillScenes
from lightning_modules.data.loading import end_when_orphaned
from lightning_modules.motion import Spike2Flow
from lightning_modules.networks import CSCSR
from lightning_modules.storage.checkpoint import read_checkpoint
from lightning_modules.storage.pretrained import check_settings
from lightning_modules.tasks.base import Learner
from lightning_modules.tasks.checkpoint_io import Checkpoints
from lightning_modules.tasks.optical_flow import FlowTraining
from lightning_modules.tasks.predictions import is_film, pictures_folder
from lightning_modules.tasks.super_resolution import SuperResolution
from lightning_modules.tasks.training_state import Begun, check_like_fresh, check_training_state, restoring
from spikekit.arguments import one_line
from spikekit.io import PictureError, SpikeFileError, VideoError
from spikekit.io.video import PICTURE_ENDINGS, VIDEO_ENDINGS
from spikekit.io.video_output import check_film
from spikekit.io.whole_file import whole_file
from spikekit.timing import duration

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

# warnings about the insides of Lightning and jsonargparse, about seeds, and about data that need no processes to read
_NOTHING_TO_DO = (
    r".*does not have many workers",
    r".*isinstance\(treespec, LeafSpec\)",
    r"\s*skip_none parameter was deprecated",
    r"Total length of",
    r"\s*``[\w.]+`` was deprecated",
    r"No seed found",
    r".*the `outputs` folder",
)

# environment variable: number of the process that starts the others, where a run has several
_FIRST = "SPIKEKIT_FIRST_PROCESS"

# of what users may take the output for
_FILE_ENDINGS = (*PICTURE_ENDINGS, *VIDEO_ENDINGS, ".gif", ".html", ".npz", ".dat", ".ckpt", ".safetensors")

_LOADERS = {
    "fit": "train_dataloader",
    "validate": "val_dataloader",
    "test": "test_dataloader",
    "predict": "predict_dataloader",
}


class Parser(LightningArgumentParser):
    """A parser whose help also lists the arguments of the classes that a configuration may name."""

    def format_help(self) -> str:  # noqa: D102
        text = super().format_help()
        if any(action.dest == "model" for action in self._actions):
            for option, choice in CHOICES:
                parser = ArgumentParser(add_help=False, usage=argparse.SUPPRESS)
                parser.add_class_arguments(choice, option)
                text += f"\nwith --{option} {choice.__name__}:\n\n{parser.format_help()}"
        return text

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Report the error in one line: jsonargparse would show every option and everything it tried to build."""
        if not self.exit_on_error:
            super().error(message, ex)
        if "the following arguments are required: network" in message:
            message = (
                "expected a network: --speed balanced (predict alone), --model.weights NAME (lightning models lists "
                "them), or a configuration, -c FILE"
            )
        if "the following arguments are required: predict.data" in message:
            message = NO_RECORDING
        sys.exit(reason(message))


class Configuration(SaveConfigCallback):
    """Writes ``config.yaml``, whole or not at all; not to ``trainer.log_dir``, which waits for other processes."""

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:  # noqa: D102
        with whole_file(Path(trainer.default_root_dir) / self.config_filename, "w", encoding="utf-8") as file:
            file.write(self.parser.dump(self.config, skip_none=False))


class Command(LightningCLI):
    """The ``lightning`` command.

    Attributes:
        typed: verb and arguments.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        typed = kwargs.get("args")
        typed = sys.argv[1:] if typed is None else typed
        self.typed = ["--help" if word == "--help=all" else word for word in typed]
        super().__init__(*args, **kwargs)

    def subcommands(self) -> dict[str, set[str]]:
        """Return only the verb that was typed, because building the parser of every verb takes time."""
        verbs = LightningCLI.subcommands()
        return {verb: verbs[verb] for verb in self.typed[:1] if verb in verbs} or verbs

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:  # noqa: D102
        parser.add_argument(
            "-o",
            "--output",
            type=str,
            default="runs",
            help="Folder of the run: checkpoints, TensorBoard files, config.yaml, tables and pictures; of predict also "
            "a film, .mp4, .mov, .mkv or .gif, or, of a single frame, a .png.",
        )
        parser.set_defaults({"model": {"class_path": "SuperResolution"}})
        network = "model.init_args.network.init_args"
        for name in ("scale", "frames", "alpha"):
            parser.link_arguments(f"{network}.{name}", f"data.init_args.{name}")
        parser.link_arguments(f"{network}.pattern", "data.init_args.crop_to")
        parser.link_arguments("model.init_args.flow", "data.init_args.flow_patch", {"scene": 0, "estimated": 48}.get)
        parser.link_arguments(
            "model", "data.init_args.flow_times", lambda model: model.flow_times[::2], apply_on="instantiate"
        )

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:  # noqa: D102
        args, said = classes_first(with_current_overlays(self.typed)), ""
        try:
            if any(option in ("--speed", "--budget") for _, option, _ in options(args)):
                args, said = prediction.with_choice(parser, args)
            try:
                args = with_network_of_weights(args)
            except (OSError, ValueError) as error:
                raise InputError(str(error)) from error
            self.config = parser.parse_args(args)
        except SystemExit as error:
            if not isinstance(error.code, str):
                raise
            names = [name.removeprefix("--") for name in option_names(*self._subcommand_parsers.values())]
            meant = suggestion(unknown(self.typed, names), names)
            if error.code.startswith("data.frames: "):
                meant = ", the frames of a clip; --data.frame chooses pictures"
            raise UsageError(error.code + (meant or f" (see lightning {self.typed[0]} --help)")) from error
        self.counts = whole_counts(args)
        if said:
            print(said, flush=True)

    def _parse_ckpt_path(self) -> None:
        """Take no hyper-parameters out of a checkpoint: jsonargparse would build whatever they name."""

    def _prepare_subcommand_parser(self, klass: type, subcommand: str, **kwargs: Any) -> LightningArgumentParser:
        parser = super()._prepare_subcommand_parser(klass, subcommand, **kwargs)
        if subcommand == "predict":
            prediction.add_arguments(parser)
        return parser

    def before_instantiate_classes(self) -> None:
        """Turn ``--ckpt_path best`` and ``last`` into files, and keep a run from being written over."""
        config = self.config[self.subcommand]
        predicts = self.subcommand == "predict"
        if predicts and is_film(config.output):
            check_film(config.output)
        check_folder(pictures_folder(config.output) if predicts else config.output)
        checkpoints = Path(config.output) / "checkpoints"
        asked = config.get("ckpt_path")
        if asked in ("best", "last"):
            last, best = checkpoints / "last.ckpt", checkpoints / "best.ckpt"
            # a run that was killed before its first last.ckpt has best.ckpt alone
            config.ckpt_path = str(last if asked == "last" and (last.is_file() or not best.is_file()) else best)
        if asked and not Path(config.ckpt_path).is_file():
            raise InputError(f"{config.ckpt_path}: no such checkpoint")
        if asked:
            try:
                checkpoint = read_checkpoint(config.ckpt_path)
                if self.subcommand == "fit":
                    check_training_state(checkpoint, config.ckpt_path)
            except (OSError, ValueError) as error:
                raise InputError(str(error)) from error
        if (
            self.subcommand == "fit"
            and not asked
            and not config.trainer.fast_dev_run
            and any(checkpoints.glob("*.ckpt"))
        ):
            raise InputError(f"{checkpoints}: holds a run already; --ckpt_path last goes on with it, -o goes elsewhere")

    def _run_subcommand(self, subcommand: str) -> None:
        config = self.config[subcommand]
        begun, begin = Begun(), perf_counter()
        self.trainer.callbacks.append(begun)
        try:
            if config.ckpt_path:  # before a folder is made and scenes are loaded
                check_settings(self.model.network, read_checkpoint(config.ckpt_path)["network"], config.ckpt_path)
            with _locked(subcommand, config), restoring(config.ckpt_path, begun):
                if subcommand == "predict" and config.engine == "ray":
                    folder = Path(pictures_folder(config.output))
                    make_parts(self.typed, folder, str(self.trainer.precision), config.jobs)
                super()._run_subcommand(subcommand)
        except (MisconfigurationException, ModuleNotFoundError) as error:  # of Lightning's, such as a callback's
            raise InputError(one_line(error)) from error
        except ValueError as error:
            if begun or isinstance(error, FolderError):
                raise
            raise InputError(str(error)) from error
        if rank_zero_only.rank == 0:
            print(f"{config.output}: {subcommand} took {duration(perf_counter() - begin)}")

    def _dump_config(self) -> None:
        # as it is there, without looking a second time at what parse_args has looked at
        if not hasattr(self, "config_dump"):
            text = self.parser.dump(self.config, skip_link_targets=False, skip_none=False, skip_validation=True)
            self.config_dump = yaml.safe_load(text)[self.subcommand]

    def instantiate_classes(self) -> None:  # noqa: D102
        config = self.config[self.subcommand]
        if self.subcommand == "fit":
            _check_trainer(config.trainer)
        try:
            super().instantiate_classes()
            # here, so that what is wrong with it is known before anything is written
            _check_verb(self.subcommand, self.model, self.datamodule)
            self.datamodule.setup(self.subcommand)
            if self.subcommand == "predict":
                prediction.check_output(Path(config.output), self.datamodule.clips)
            _check_agreement(self.model, self.datamodule)
            if self.subcommand == "fit":
                chosen = self.config_dump["model"]["init_args"]
                self.model.recipe = {name: chosen.get(name) for name in ("optimizer", "lr_scheduler")}
                if config.ckpt_path:
                    _check_continuation(config.ckpt_path, self.model, self.trainer)
        except (OSError, ValueError, ModuleNotFoundError) as error:
            # jsonargparse wraps what a class of a class says into pages about its own types
            said = reason(str(error))
            raise (InputError if _is_of_file(error, said) else UsageError)(said) from error

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Send everything to one folder, and use bfloat16 on a GPU that supports it."""
        output = Path(self._get(self.config_init, "output"))
        config = self._get(self.config_init, "trainer")
        kwargs["default_root_dir"] = output
        kwargs |= self.counts
        if config.get("logger") is None:
            # the tables and pictures of the other commands are files of their own
            kwargs["logger"] = TensorBoardLogger(output, name="", version="") if self.subcommand == "fit" else False
        kwargs["plugins"] = [Checkpoints(), *_listed(config.get("plugins"))]
        if config.get("precision") is None:
            kwargs["precision"] = precision_of(config.get("accelerator"))
        if self.subcommand == "predict":
            precision = kwargs.get("precision", config.get("precision"))
            callbacks = prediction.callbacks(output, self.config_dump, precision, _listed(config.get("callbacks")))
        else:
            callbacks = self._callbacks(output)
        kwargs["callbacks"] = [*_listed(config.get("callbacks")), *callbacks]
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
        return [self.model.report(output)] if self.subcommand == "test" else []


def _locked(verb: str, config: Any) -> AbstractContextManager[None]:
    """Keep a second run of a verb out of what it writes; processes of one distributed run share it."""
    if rank_zero_only.rank != 0 or verb == "validate" or (verb == "fit" and config.trainer.fast_dev_run):
        return nullcontext()
    if verb == "fit":
        return locked_folder(config.output, "run")
    # what is predicted while a training runs may go to its folder; among pictures the file is hidden
    folder = pictures_folder(config.output) if verb == "predict" else config.output
    if verb == "predict" and config.part is not None:  # one of several that share it
        make_folder(folder)
        return nullcontext()
    return locked_folder(folder, f"lightning {verb}", f".{verb}.lock")


def option_names(*parsers: ArgumentParser) -> list[str]:
    """Return the options of parsers, and those of the classes that a configuration may name."""
    own = [option for parser in parsers for option in parser._option_string_actions]
    classes = [f"--{option}.{name}" for option, choice in CHOICES for name in signature(choice).parameters]
    return sorted({*own, *classes})


def _is_of_file(error: BaseException | None, said: str) -> bool:
    """Return whether a file is to blame, and not what was typed."""
    if Path(said.partition(": ")[0]).exists():
        return True
    while error is not None:
        if isinstance(error, (OSError, SpikeFileError, PictureError, VideoError)):
            return True
        error = error.__cause__ or error.__context__
    return False


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [] if value is None else [value]


def check_folder(output: str | Path) -> None:
    """Refuse an output that cannot be a folder, or would be a folder that looks like a file.

    Raises:
        InputError: it is a file, or inside one, or new and ends like a picture, a film or another file.
    """
    ending = Path(output).suffix.lower()
    kind = guess_type(Path(output).name)[0] or ""
    looks_like_file = ending in _FILE_ENDINGS or kind.startswith(("image/", "video/", "audio/"))
    if looks_like_file and not Path(output).is_dir():
        raise UsageError(f"-o: expected a folder, got {output}, which ends like a file, in {ending}")
    there = next(path for path in (Path(output).absolute(), *Path(output).absolute().parents) if path.exists())
    if not there.is_dir():
        raise UsageError(f"-o: expected a folder, got the file {there}")


def _check_trainer(trainer: Any) -> None:
    """Settings of Lightning that would leave a run without what the other commands need."""
    if trainer.enable_checkpointing is False:
        raise UsageError("trainer.enable_checkpointing: expected true, checkpoints are what fit is for, got false")
    if trainer.limit_val_batches == 0:
        raise UsageError("trainer.limit_val_batches: expected more than 0, validation chooses best.ckpt, got 0")


def _check_verb(verb: str, model: Learner, data: LightningDataModule) -> None:
    if verb == "predict" and type(model).predict_step is LightningModule.predict_step:
        raise UsageError(f"predict: expected a model that makes pictures, got {type(model).__name__}")
    loader = _LOADERS[verb]
    if getattr(type(data), loader) is getattr(LightningDataModule, loader):
        scenes = f"{verb}: expected scenes whose truth is known, got {type(data).__name__}"
        raise UsageError(NO_RECORDING if verb == "predict" else scenes)
    if verb == "fit" and not any(parameter.requires_grad for parameter in model.network.parameters()):
        raise UsageError(f"fit: expected a network that learns, got {type(model.network).__name__}")


def _check_continuation(path: str, model: Learner, trainer: Trainer | None) -> None:
    """Refuse to go on with another network, optimizer or schedule: the checkpoint's would win without a word."""
    checkpoint = read_checkpoint(path)
    check_settings(model.network, checkpoint["network"], path)
    here = dict(flatten(model.recipe))
    there = dict(flatten(checkpoint["recipe"] or model.recipe))  # older checkpoints do not say
    for key in sorted({**there, **here}):
        if there.get(key) != here.get(key):
            name, expected = key.replace(".init_args", ""), f"{there.get(key)}, as {path} was trained with"
            anew = "--model.weights starts anew with other settings"
            raise UsageError(f"model.{name}: expected {expected}, got {here.get(key)}; {anew}")
    if trainer is not None:  # a rehearsal has none
        check_like_fresh(checkpoint, path, model, trainer)


def _check_agreement(model: Learner, data: LightningDataModule) -> None:
    """Refuse a model and data that disagree; a recording has a Bayer phase of its own."""
    if not isinstance(data, (StillScenes, FilmScenes)):
        return
    if data.workers < 0:
        raise ValueError(f"data.workers: expected 0 or more, got {data.workers}")
    for name, expected in model.needs.items():
        got = data.options[name]
        if got != expected:
            raise ValueError(f"data.{name}: expected {expected}, as the model has it, got {got}")


def precision_of(accelerator: str) -> str:
    """Return bfloat16 for a GPU that supports it, float32 otherwise."""
    wanted = accelerator in ("auto", "gpu", "cuda") and torch.cuda.is_available() and torch.cuda.is_bf16_supported()
    return "bf16-mixed" if wanted else "32-true"


def without_chatter() -> None:
    """Let Lightning say nothing that a user cannot act upon."""
    for says in ("pytorch_lightning.utilities.rank_zero", "lightning_fabric.utilities.seed"):
        logging.getLogger(says).setLevel(logging.WARNING)  # tips, and which devices there are
    for nothing_to_do in _NOTHING_TO_DO:
        warnings.filterwarnings("ignore", nothing_to_do)


def run(args: Sequence[str] | None, command: type[Command]) -> Command:
    """Run what was typed after ``lightning``, with one of Lightning's verbs; errors are raised."""
    without_chatter()
    if not rank_zero_only.rank:
        os.environ[_FIRST] = str(os.getpid())
    elif os.environ.get(_FIRST) == str(os.getppid()):
        end_when_orphaned()
    return command(
        Learner,
        LightningDataModule,
        subclass_mode_model=True,
        subclass_mode_data=True,
        auto_configure_optimizers=False,
        parser_class=Parser,
        save_config_callback=Configuration,
        save_config_kwargs={"save_to_log_dir": False},
        args=None if args is None else list(args),
    )
