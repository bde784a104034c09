"""The quick answer of ``--help``: the verbs, and the most common options of those that are Lightning's."""

from __future__ import annotations

#: what every verb does
VERBS = {
    "fit": "Train a network on clips whose truth is known.",
    "validate": "Score a trained network on the clips that fit validates on.",
    "test": "Score a trained network beside the classical decoders: a table and pictures.",
    "predict": "Make colour pictures of a recording.",
    "sweep": "Train and test every combination of overlays, values and seeds.",
    "trade": "Measure the cost and the quality of every setting.",
    "adapt": "Fine-tune fast weights on a recording, without ground truth.",
    "export": "Write a network for other programs: safetensors, torch.export or ONNX.",
    "models": "List the weights that come with the package.",
}

#: what every one of Lightning's verbs has to be told, by examples
_EXAMPLES = {
    "fit": "lightning fit -c configs/x4.yaml -c configs/quick.yaml -o runs/mine",
    "validate": "lightning validate -c configs/x4.yaml --ckpt_path best",
    "test": "lightning test -c configs/x4.yaml --model.weights cscsr_small_x4",
}

_OPTIONS = {
    "-c FILE": "configuration; later ones override earlier ones",
    "--data NAME": "StillScenes, from pictures (default), or FilmScenes, from films",
    "--data.root FOLDER": "the pictures or films; those of scikit-image if not given",
    "--model.weights NAME": "weights to start with: a name that lightning models lists, a .safetensors or a .ckpt file",
    "--ckpt_path FILE": "checkpoint of this configuration; best and last are of the folder; fit resumes with last",
    "--trainer.max_steps N": "how long to train",
    "--trainer.accelerator NAME": "cpu, gpu or auto; auto if not given",
    "--trainer.precision NAME": "such as 32-true or bf16-mixed; if not given, bf16-mixed on a GPU that supports it",
    "-o FOLDER": "where everything is written; runs if not given",
}


def _aligned(rows: dict[str, str]) -> str:
    width = max(map(len, rows)) + 2
    return "\n".join(f"  {name:{width}}{said}" for name, said in rows.items())


def overview() -> str:
    """Return what ``lightning --help`` says."""
    return (
        f"usage: lightning VERB ...\n\n{_aligned(VERBS)}\n\n"
        "lightning VERB --help lists options of a verb, lightning --version prints the version."
    )


def usage(verb: str) -> str:
    """Return what ``lightning VERB --help`` prints for one of Lightning's verbs.

    Example:
        >>> print(usage("fit").splitlines()[0])
        lightning fit: Train a network on clips whose truth is known.
    """
    return (
        f"lightning {verb}: {VERBS[verb]}\n\n{_aligned(_OPTIONS)}\n\nexample:\n  {_EXAMPLES[verb]}\n\n"
        f"lightning {verb} --help=all lists every option, also those of Lightning's Trainer; --model.help CLASS and "
        "--data.help CLASS those of a model and of data, such as SuperResolution and StillScenes; and --print_config "
        "prints what would be used."
    )
