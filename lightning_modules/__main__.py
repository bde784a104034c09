"""Entry point of the ``lightning`` command and of ``python -m lightning_modules``, with its short help texts."""

from __future__ import annotations

import atexit
import ctypes
import gc
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module

from lightning_modules.configurations import with_found_configs

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # in glibc's malloc.h

#: descriptions of the verbs
_VERBS = {
    "fit": "Train a network on clips with ground truth.",
    "validate": "Score a trained network on the validation clips of fit.",
    "test": "Compare a trained network with the classical decoders: a table and pictures.",
    "predict": "Make pictures of a recording.",
    "sweep": "Train and test every combination of overlays, values and seeds.",
    "trade": "Measure cost and quality of every setting.",
    "adapt": "Fine-tune a small model on a recording, with a large one as teacher.",
    "export": "Export a network for other programs: safetensors, torch.export or ONNX.",
    "models": "List the weights of the package.",
}

#: an example for each of Lightning's verbs
_EXAMPLES = {
    "fit": "lightning fit -c x4 -c quick -o runs/mine",
    "validate": "lightning validate -c x4 --ckpt_path best",
    "test": "lightning test -c x4 --model.weights cscsr_small_x4",
}

_OPTIONS = {
    "-c FILE": "configuration; later ones override earlier ones",
    "--data NAME": "StillScenes, from pictures (default), FilmScenes, from films, or for test RecordingScenes",
    "--data.root FOLDER": "folder of pictures or films; default: pictures of scikit-image",
    "--model.weights NAME": "initial weights: a name listed by lightning models, a .safetensors or a .ckpt file",
    "--ckpt_path FILE": "checkpoint of this configuration; best and last: of the folder; fit resumes with last",
    "--trainer.max_steps N": "number of training steps",
    "--trainer.accelerator NAME": "cpu, gpu or auto; default: auto",
    "--trainer.precision NAME": "such as 32-true or bf16-mixed; default: bf16-mixed on a GPU that supports it",
    "-o FOLDER": "output folder; default: runs",
}

#: modules of the verbs that Lightning does not provide
_OURS = {
    "predict": "cli.predict",
    "sweep": "sweep.cli",
    "trade": "trade.cli",
    "adapt": "adaptation.cli",
    "export": "cli.export",
    "models": "cli.models",
}


def main(args: Sequence[str] | None = None) -> None:
    """Run the command, given the arguments after ``lightning``. Default: those of ``sys.argv``."""
    typed = sys.argv[1:] if args is None else list(args)
    # Set before torch is imported: its idle threads would spin and slow down the data workers.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with suppress(AttributeError, TypeError):  # where the C library is not glibc
        allocator = ctypes.CDLL(None)
        # Freed memory is kept, as every picture would return and fault it in again; arrays above 32 MiB are returned.
        allocator.mallopt(_MMAP_THRESHOLD, 1 << 25)
        allocator.mallopt(_TRIM_THRESHOLD, 1 << 30)
    starts = "torch" not in sys.modules
    try:
        with _importing(starts):
            from lightning_modules.cli import errors  # with torch, which takes seconds
            from spikekit.standard_output import stopped_by_sigterm
    except KeyboardInterrupt:
        print("lightning: stopped by Ctrl-C", file=sys.stderr)  # noqa: T201
        raise SystemExit(130) from None
    with errors.as_one_line():
        verb, *rest = typed or [""]
        if verb in ("-h", "--help"):
            print(_overview())  # noqa: T201
        elif verb == "--version":
            from spikekit import __version__

            print(f"lightning of spikekit {__version__}")  # noqa: T201
        elif verb not in _VERBS:
            expected = f"expected a verb, one of {', '.join(_VERBS)}, got {verb or 'none'}"
            raise errors.Ended(f"lightning: {expected} (see lightning --help)", 2)
        elif verb not in _OURS and {"-h", "--help"} & {*rest}:
            print(_usage(verb))  # noqa: T201
        else:
            if "" not in sys.path and os.getcwd() not in sys.path:
                sys.path.append(os.getcwd())  # for users' own networks; last, so that it shadows nothing
            with _importing(starts):
                module = import_module(f"lightning_modules.{_OURS.get(verb, 'cli.command')}")
            if verb in _OURS:
                with stopped_by_sigterm():  # Lightning handles SIGTERM itself and saves a checkpoint
                    getattr(module, verb)(with_found_configs(rest))
            else:
                module.run(typed)


@contextmanager
def _importing(starts: bool) -> Iterator[None]:
    """In a new process, do not search imports for garbage, now or at exit: it takes a fifth of the first picture."""
    if starts:
        gc.disable()
    try:
        yield
    finally:
        if starts:
            gc.freeze()
            gc.enable()
            if "triton" in sys.modules:  # it reports what is not collected at exit as leaks, in thirty lines
                atexit.register(gc.unfreeze)


def _aligned(rows: dict[str, str]) -> str:
    width = max(map(len, rows)) + 2
    return "\n".join(f"  {name:{width}}{said}" for name, said in rows.items())


def _overview() -> str:
    """Return the text of ``lightning --help``."""
    return (
        f"usage: lightning VERB ...\n\n{_aligned(_VERBS)}\n\n"
        "lightning VERB --help lists the options of a verb; lightning --version prints the version."
    )


def _usage(verb: str) -> str:
    """Return the text of ``lightning VERB --help`` for one of Lightning's verbs."""
    return (
        f"lightning {verb}: {_VERBS[verb]}\n\n{_aligned(_OPTIONS)}\n\nexample:\n  {_EXAMPLES[verb]}\n\n"
        f"lightning {verb} --help=all lists all options, also those of Lightning's Trainer. --model.help CLASS and "
        "--data.help CLASS list those of a model and of data, such as SuperResolution and StillScenes. --print_config "
        "prints the complete configuration."
    )


if __name__ == "__main__":
    main()
