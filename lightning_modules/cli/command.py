"""The ``lightning`` command: LightningCLI with one output folder, which also holds its checkpoints."""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from time import perf_counter
from typing import Any, NoReturn

import torch
import yaml
from jsonargparse import Namespace
from pytorch_lightning import Callback, LightningDataModule, LightningModule, Trainer
from pytorch_lightning.callbacks import LearningRateMonitor, ModelCheckpoint
from pytorch_lightning.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from pytorch_lightning.loggers import TensorBoardLogger
from pytorch_lightning.utilities import rank_zero_only
from pytorch_lightning.utilities.exceptions import MisconfigurationException, SIGTERMException

from lightning_modules.cli.arguments import flatten, given_data, with_network_of_weights
from lightning_modules.cli.configured import run_checkpoint
from lightning_modules.cli.errors import Ended, InputError, UsageError, causes, input_errors
from lightning_modules.cli.folder_lock import check_folder, locked_folder
from lightning_modules.cli.reasons import reason
from lightning_modules.configurations import with_found_configs
from lightning_modules.data.loading import end_when_orphaned
from lightning_modules.inference.predict import precision_of
from lightning_modules.storage.checkpoint import read_checkpoint
from lightning_modules.storage.pretrained import check_settings
from lightning_modules.tasks import optical_flow, super_resolution  # noqa: F401  (classes that --model names)
from lightning_modules.tasks.base import BaseTask, check_resume, load_weights_of
from lightning_modules.tasks.checkpoint_io import Checkpoints, LastCheckpoint, requeued_checkpoint
from spikekit.arguments import one_line
from spikekit.io import PictureError, SpikeFileError, VideoError
from spikekit.io.whole_file import write_whole
from spikekit.timing import duration

# warnings that users cannot act upon: internals of Lightning and jsonargparse, seeds, and data without workers
_NOTHING_TO_DO = (
    r".*does not have many workers",
    r".*isinstance\(treespec, LeafSpec\)",
    r"\s*skip_none parameter was deprecated",
    r"Total length of",
    r"\s*``[\w.]+`` was deprecated",
    r"No seed found",
    r".*the `outputs` folder",
    r"Be aware that when using `ckpt_path`",
    r"Checkpoint directory .* exists",
    r"`ModelCheckpoint\(monitor=.*could not find",
)

# an int is a number of batches, a float a fraction
_COUNTS = {f"trainer.limit_{stage}_batches" for stage in ("train", "val", "test", "predict")}
_COUNTS |= {"trainer.overfit_batches", "trainer.val_check_interval"}

# arguments of the network that its data follow
_SHARED = "scale", "frames", "alpha"

# environment variable: id of the process that starts the others of a distributed run
_FIRST = "SPIKEKIT_FIRST_PROCESS"


class Parser(LightningArgumentParser):
    """A parser of a verb, whose errors are one line."""

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Report the error in one line; jsonargparse would show every option and every type it tried."""
        if not self.exit_on_error:
            super().error(message, ex)
        raise Ended(f"lightning: {reason(message)} (see lightning {self.subcommand} --help)", 2)


class Configuration(SaveConfigCallback):
    """Write ``config.yaml`` atomically; not to ``trainer.log_dir``, as reading it waits for other processes."""

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:  # noqa: D102
        text = self.parser.dump(self.config, skip_none=False)
        write_whole(Path(trainer.default_root_dir) / self.config_filename, text)


class Command(LightningCLI):
    """The ``lightning`` command with a verb and its arguments."""

    def __init__(self, typed: Sequence[str]) -> None:
        self.typed = with_found_configs("--help" if word == "--help=all" else word for word in typed)
        super().__init__(
            BaseTask,
            LightningDataModule,
            subclass_mode_model=True,
            subclass_mode_data=True,
            auto_configure_optimizers=False,
            parser_class=Parser,
            save_config_callback=Configuration,
            save_config_kwargs={"save_to_log_dir": False},
            args=self.typed,
        )

    def subcommands(self) -> dict[str, set[str]]:
        """Return only the given verb, as building the parsers of all verbs takes time."""
        return {verb: LightningCLI.subcommands()[verb] for verb in self.typed[:1]}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:  # noqa: D102
        parser.add_argument(
            "-o",
            "--output",
            type=os.path.expanduser,
            default="runs",
            help="Folder of the run: checkpoints, TensorBoard files, config.yaml, tables and pictures.",
        )
        for action in parser._actions:
            if action.dest in _COUNTS:  # 1 is one batch, 1.0 is all batches
                action._typehint = int | float | None
        parser.set_defaults({"model": {"class_path": "SuperResolution"}})
        network = "model.init_args.network.init_args"
        for name in _SHARED:
            parser.link_arguments(f"{network}.{name}", f"data.init_args.{name}")
        parser.link_arguments("model.init_args.flow", "data.init_args.flow_patch", _flow_patch)
        parser.link_arguments("model", "data.init_args.flow_times", _ends, apply_on="instantiate")

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:  # noqa: D102
        with input_errors():
            verb, *words = with_network_of_weights(self.typed)
        own = self._parser(verb)  # the one above it would complete and check everything once more
        above = vars(own).pop("parent_parser", None)  # --print_config would be left to it
        self.config = Namespace(subcommand=verb, **{verb: own.parse_args(words)})
        own.parent_parser = above
        self.given = given_data(self.typed)
        for name in _SHARED:
            expected = self.config.get(f"{verb}.data.init_args.{name}", self.given.get(name))
            self._check_given(name, expected, f"the value of model.network.{name}")
        flow = self.config.get(f"{verb}.model.init_args.flow")
        self._check_given("flow_patch", _flow_patch(flow), "as model.flow sets it")

    def _check_given(self, name: str, expected: Any, reason: str) -> None:
        """Reject an argument of the data that a link would replace without a word."""
        got = self.given.get(name, expected)
        if got != expected:
            raise UsageError(f"data.{name}: expected {expected}, {reason}, got {got}")

    def _dump_config(self) -> None:
        """Take the configuration as it is, as to check and write it once more would take as long as to build all."""
        self.config_dump = json.loads(json.dumps(self.config[self.subcommand].as_dict(), default=str))

    def _parse_ckpt_path(self) -> None:
        """Read no hyper-parameters from a checkpoint: jsonargparse would build any class that they name."""

    def before_instantiate_classes(self) -> None:
        """Turn ``--ckpt_path best`` and ``last`` into paths, and protect existing runs from being overwritten."""
        config = self.config[self.subcommand]
        if self.subcommand == "test":
            config.verbose = False  # Lightning's table; ours has all methods
        check_folder(config.output)
        checkpoints = Path(config.output) / "checkpoints"
        if self.subcommand == "fit" and not config.get("ckpt_path"):
            config.ckpt_path = requeued_checkpoint(config.output)
        asked = config.get("ckpt_path")
        if asked in ("best", "last"):
            # a run that was killed before its first last.ckpt has only best.ckpt
            alone = asked == "last" and not (checkpoints / "last.ckpt").is_file() and any(checkpoints.glob("best.ckpt"))
            config.ckpt_path = str(run_checkpoint(checkpoints, "best" if alone else asked))
        if asked:
            with input_errors():
                read_checkpoint(config.ckpt_path)
        elif self.subcommand == "fit" and not config.trainer.fast_dev_run and any(checkpoints.glob("*.ckpt")):
            raise InputError(f"{checkpoints}: holds a run already; --ckpt_path last resumes it, or choose another -o")

    def _run_subcommand(self, subcommand: str) -> None:
        config = self.config[subcommand]
        begin = perf_counter()
        try:
            if config.ckpt_path:  # before the folder is made and scenes are loaded
                checkpoint = read_checkpoint(config.ckpt_path)
                check_settings(self.model.network, checkpoint["network"], config.ckpt_path)
                load_weights_of(checkpoint, config.ckpt_path, self.model)
            elif subcommand != "fit" and any(True for _ in self.model.network.parameters()):
                chosen = config.model.init_args
                if not (chosen.get("weights") or chosen.get("network.init_args.weights")):
                    name = type(self.model.network).__name__
                    said = f"no weights given, those of {name} are random (see lightning {subcommand} --help)"
                    print(f"note: {said}", file=sys.stderr)
            with _locked(subcommand, config):
                super()._run_subcommand(subcommand)
        except (SIGTERMException, RuntimeError) as error:  # Lightning would end with status 0
            if not self.trainer.received_sigterm:
                raise
            saved = subcommand == "fit" and Path(config.output, "checkpoints", "last.ckpt").is_file()
            goes_on = "; --ckpt_path last resumes" if saved else ""
            interrupted = any(getattr(saves, "interrupted", False) for saves in self.trainer.checkpoint_callbacks)
            by, status = ("Ctrl-C", 130) if interrupted else ("SIGTERM", 143)
            raise Ended(f"lightning: {config.output}: {subcommand} was stopped by {by}{goes_on}", status) from error
        except SystemExit as error:
            if isinstance(error.__context__, KeyboardInterrupt):  # Lightning turns it into status 1
                raise KeyboardInterrupt from None
            raise
        except (MisconfigurationException, ModuleNotFoundError) as error:  # raised by Lightning, such as by a callback
            raise InputError(one_line(error)) from error
        if rank_zero_only.rank == 0:
            print(f"{config.output}: {subcommand} took {duration(perf_counter() - begin)}")

    def instantiate_classes(self) -> None:  # noqa: D102
        config = self.config[self.subcommand]
        try:
            super().instantiate_classes()
            self._check_given("flow_times", [*_ends(self.model)], "those of the network")
            # here, so that errors are found before anything is written
            self.datamodule.setup(self.subcommand)
            if (workers := getattr(self.datamodule, "workers", 0)) < 0:
                raise ValueError(f"data.workers: expected 0 or more, got {workers}")
            for name, expected in self.model.needs.items():
                if (got := self.datamodule.options.get(name, expected)) != expected:
                    raise ValueError(f"data.{name}: expected {expected}, the value of the model, got {got}")
            if self.subcommand == "fit":
                if not any(parameter.requires_grad for parameter in self.model.network.parameters()):
                    raise UsageError(f"fit: expected a network that learns, got {type(self.model.network).__name__}")
                self.model.configure_optimizers()
                chosen = self.config_dump["model"]["init_args"]
                self.model.recipe = {name: chosen.get(name) for name in ("optimizer", "lr_scheduler")}
                if config.ckpt_path:
                    _check_continuation(config.ckpt_path, self.model)
        except (OSError, ValueError, ModuleNotFoundError) as error:
            # jsonargparse wraps the errors of nested classes in pages about its own types
            said = reason(str(error))
            raise (InputError if _is_of_file(error, said) else UsageError)(said) from error

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Write everything to one folder, and use bfloat16 on a GPU that supports it."""
        kwargs["default_root_dir"] = output = Path(self._get(self.config_init, "output"))
        config = self._get(self.config_init, "trainer")
        if config.get("logger") is None:
            # the other verbs write their tables and pictures to files
            kwargs["logger"] = TensorBoardLogger(output, name="", version="") if self.subcommand == "fit" else False
        kwargs["plugins"] = [Checkpoints(output), *_listed(config.get("plugins"))]
        if config.get("precision") is None:
            gpu = config.get("accelerator") in ("auto", "gpu", "cuda") and torch.cuda.is_available()
            kwargs["precision"] = self.precision_on(torch.device("cuda" if gpu else "cpu"))
        kwargs["callbacks"] = [*_listed(config.get("callbacks")), *self._callbacks(output)]
        if self.subcommand != "fit":
            self.save_config_callback = None  # config.yaml is the record of the training
            kwargs["devices"] = 1  # several devices would score some clips twice
        try:
            return super().instantiate_trainer(**kwargs)
        except TypeError as error:  # such as -1 devices on a CPU
            raise UsageError(f"trainer: {one_line(error)}") from error

    @staticmethod
    def precision_on(device: torch.device) -> str:
        """Return the default precision on a device."""
        return precision_of(device) if device.type == "cuda" else "32-true"

    def _callbacks(self, output: Path) -> list[Callback]:
        if self.subcommand == "fit":
            monitor, mode = self.model.best
            folder = {"dirpath": output / "checkpoints", "enable_version_counter": False}
            logs = self._get(self.config_init, "trainer").get("logger") not in (False, [])
            return [
                ModelCheckpoint(filename="best", monitor=monitor, mode=mode, **folder),
                LastCheckpoint(filename="last", save_on_train_epoch_end=True, **folder),
                *([LearningRateMonitor()] if logs else []),
                self.model.pictures(),
            ]
        return [self.model.report(output)] if self.subcommand == "test" else []


class Rehearsal(Command):
    """A command that parses and builds everything and raises any errors, but runs and writes nothing."""

    verb = "test"

    def init_parser(self, **kwargs: Any) -> Any:  # noqa: D102
        return super().init_parser(**kwargs, exit_on_error=False)

    def _run_subcommand(self, subcommand: str) -> None:
        pass


def resolved(command: Rehearsal) -> dict[str, Any]:
    """Return the complete configuration of a command, as plain values."""
    return yaml.safe_load(command.parser.dump(command.config, skip_none=False, skip_validation=True))[command.verb]


def _flow_patch(flow: str | None) -> int:
    """Return the smallest side for the estimate of motion: 0 unless motion is estimated."""
    return 48 if flow == "estimated" else 0


def _ends(model: BaseTask) -> tuple[int, int]:
    """Return the first and the last of the model's flow times; not a lambda, which cannot be pickled."""
    return model.flow_times[::2]


def _locked(verb: str, config: Any) -> AbstractContextManager[None]:
    """Lock the output of a verb against a second run; processes of one distributed run share the lock."""
    if rank_zero_only.rank != 0 or verb == "validate" or (verb == "fit" and config.trainer.fast_dev_run):
        return nullcontext()
    if verb == "fit":
        return locked_folder(config.output, "run")
    return locked_folder(config.output, f"lightning {verb}", f".{verb}.lock")


def _is_of_file(error: BaseException, said: str) -> bool:
    """Whether an error is caused by a file rather than by the command line."""
    kinds = OSError, SpikeFileError, PictureError, VideoError
    return Path(said.partition(": ")[0]).exists() or any(isinstance(cause, kinds) for cause in causes(error))


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [] if value is None else [value]


def _check_continuation(path: str, model: BaseTask) -> None:
    """Check that network, optimiser and schedule are the checkpoint's, which would silently replace others."""
    checkpoint = read_checkpoint(path)
    check_settings(model.network, checkpoint["network"], path)
    here = dict(flatten(model.recipe))
    there = dict(flatten(checkpoint["recipe"] or model.recipe))  # older checkpoints have no recipe
    for key in sorted({**there, **here}):
        if there.get(key) != here.get(key):
            name, expected = key.replace(".init_args", ""), f"{there.get(key)}, as {path} was trained with"
            anew = "to start anew with other settings, use --model.weights"
            raise UsageError(f"model.{name}: expected {expected}, got {here.get(key)}; {anew}")
    check_resume(checkpoint, path, model)


def without_chatter() -> None:
    """Silence messages of Lightning that users cannot act upon."""
    signals = "pytorch_lightning.trainer.connectors.signal_connector"
    for says in ("pytorch_lightning.utilities.rank_zero", "lightning_fabric.utilities.seed", signals):
        logging.getLogger(says).setLevel(logging.WARNING)  # tips, lists of devices, and what our last line says
    for nothing_to_do in _NOTHING_TO_DO:
        warnings.filterwarnings("ignore", nothing_to_do)


def _quiet_about_disks(failed: threading.ExceptHookArgs) -> None:
    """Hide errors of a full disk in threads: TensorBoard raises them again in the main thread."""
    if not isinstance(failed.exc_value, OSError):
        threading.__excepthook__(failed)


def run(typed: Sequence[str], command: type[Command] = Command) -> Command:
    """Run one of Lightning's verbs with the arguments given after ``lightning``; errors are raised."""
    without_chatter()
    threading.excepthook = _quiet_about_disks
    if not rank_zero_only.rank:
        os.environ[_FIRST] = str(os.getpid())
    elif os.environ.get(_FIRST) == str(os.getppid()):
        end_when_orphaned()
    return command(typed)
