"""Short ``--help`` texts: the verbs, and the most common options of Lightning's verbs."""

from __future__ import annotations

#: descriptions of the verbs
VERBS = {
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


def _aligned(rows: dict[str, str]) -> str:
    width = max(map(len, rows)) + 2
    return "\n".join(f"  {name:{width}}{said}" for name, said in rows.items())


def overview() -> str:
    """Return the text of ``lightning --help``."""
    return (
        f"usage: lightning VERB ...\n\n{_aligned(VERBS)}\n\n"
        "lightning VERB --help lists the options of a verb; lightning --version prints the version."
    )


def usage(verb: str) -> str:
    """Return the text of ``lightning VERB --help`` for one of Lightning's verbs.

    Example:
        >>> print(usage("fit").splitlines()[0])
        lightning fit: Train a network on clips with ground truth.
    """
    return (
        f"lightning {verb}: {VERBS[verb]}\n\n{_aligned(_OPTIONS)}\n\nexample:\n  {_EXAMPLES[verb]}\n\n"
        f"lightning {verb} --help=all lists all options, also those of Lightning's Trainer. --model.help CLASS and "
        "--data.help CLASS list those of a model and of data, such as SuperResolution and StillScenes. --print_config "
        "prints the complete configuration."
    )
