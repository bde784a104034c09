"""The quick answer of ``--help``: the verbs, and the most common options of each."""

from __future__ import annotations

from collections.abc import Iterable

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

_Options = dict[str, str]

_CONFIG = {"-c FILE": "configuration; later ones override earlier ones: -c configs/x4.yaml -c configs/quick.yaml"}
_OUTPUT = {"-o FOLDER": "where everything is written; runs if not given"}
_TRAINER = {
    "--trainer.accelerator NAME": "cpu, gpu or auto; auto if not given",
    "--trainer.precision NAME": "such as 32-true or bf16-mixed; if not given, bf16-mixed on a GPU that supports it",
}
_WEIGHTS = {
    "--model.weights NAME": "weights to start with: a name that lightning models lists, a .safetensors or a .ckpt file"
}
_CHECKPOINT = {"--ckpt_path FILE": "checkpoint of this configuration; best and last are those of the folder"}
_SCENES = {
    "--data NAME": "StillScenes, from pictures (default), or FilmScenes, from films",
    "--data.root FOLDER": "the pictures or films; those of scikit-image if not given",
}
_INFERENCE = {
    "--model.tile N": "side of the tiles that large recordings are cut into, in sensor pixels; 0 for none",
    "--model.psnr_tolerance DB": "skip work that costs no more than this in PSNR",
    "--model.self_ensemble N": "2, 4 or 8: the mean over that many views of a clip (mirrored, turned, transposed)",
}

_OPTIONS: dict[str, tuple[str, _Options]] = {
    "fit": (
        "lightning fit -c configs/x4.yaml -c configs/quick.yaml",
        {
            **_CONFIG,
            **_SCENES,
            **_WEIGHTS,
            "--ckpt_path last": "resume the run in the folder; or best, or a file",
            "--trainer.max_steps N": "how long to train",
            **_TRAINER,
            **_OUTPUT,
        },
    ),
    "validate": (
        "lightning validate -c configs/x4.yaml --ckpt_path best",
        {**_CONFIG, **_SCENES, **_WEIGHTS, **_CHECKPOINT, **_TRAINER, **_OUTPUT},
    ),
    "test": (
        "lightning test -c configs/x4.yaml --model.weights cscsr_small_x4",
        {**_CONFIG, **_SCENES, **_WEIGHTS, **_CHECKPOINT, **_INFERENCE, **_TRAINER, **_OUTPUT},
    ),
    "predict": (
        "lightning predict --speed balanced --data Recording --data.path FILE.dat --data.height 250 --data.width 400",
        {
            "--data Recording": "the data are a recording, described by:",
            "--data.path FILE": "the recording, .dat or .npz",
            "--data.height H": "rows of a frame; a .dat without side-car or camera needs it",
            "--data.width W": "columns of a frame; likewise",
            "--data.flip true": "the frames are stored upside down, as real cameras do",
            "--data.pattern P": "Bayer phase: RGGB, BGGR, GRBG or GBRG; RGGB if nothing else is known",
            "--data.camera NAME": "the camera that recorded it, instead of all these; spikekit cameras lists them",
            "--data.frame A:B:STEP": "which frames to make pictures of, or N for a single one; every 20th if not given",
            "--data.white RATE": "spikes per frame of a pixel that is shown white; measured if not given",
            "--speed NAME": "weights of the package: fastest, fast, balanced or best",
            "--budget 2s": "instead, what a picture may cost, such as 40ms or 200MB: the best that fits",
            "--model.network.scale S": "with these two, pictures of S times the sensor's size; 4 if not given",
            "--model.weights NAME": "instead, weights: a name that lightning models lists, a .safetensors, a .ckpt",
            **_INFERENCE,
            **_TRAINER,
            "-o OUT": "a folder, a film (.mp4, .mov, .mkv, .gif) or, of a single frame, a .png; runs if not given",
        },
    ),
}


def _aligned(rows: Iterable[tuple[str, str]]) -> str:
    rows = list(rows)
    width = max(len(name) for name, _ in rows) + 2
    return "\n".join(f"  {name:{width}}{said}" for name, said in rows)


def overview() -> str:
    """Return what ``lightning --help`` says."""
    return (
        f"usage: lightning VERB ...\n\n{_aligned(VERBS.items())}\n\n"
        "lightning VERB --help lists options of a verb, lightning --version prints the version, and\n"
        "lightning --print-completion bash (or zsh) prints the script for tab completion."
    )


def usage(verb: str) -> str:
    """Return what ``lightning VERB --help`` prints for one of Lightning's verbs.

    Example:
        >>> print(usage("predict").splitlines()[0])
        lightning predict: Make colour pictures of a recording.
    """
    example, chosen = _OPTIONS[verb]
    return (
        f"lightning {verb}: {VERBS[verb]}\n\n{_aligned(chosen.items())}\n\nexample:\n  {example}\n\n"
        f"lightning {verb} --help=all lists every option, also those of networks, data and Lightning's Trainer, and "
        "--print_config prints what would be used."
    )


def options_of(verb: str) -> list[str]:
    """Return the options that :func:`usage` lists, without their values."""
    return [name.split()[0] for name in _OPTIONS[verb][1]]
