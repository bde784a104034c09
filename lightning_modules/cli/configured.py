"""Build the network of a configuration without Lightning, for verbs that need no Trainer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lightning_modules.cli.arguments import inner_arguments, read_config
from lightning_modules.cli.errors import InputError, UsageError
from lightning_modules.cli.reasons import reason
from lightning_modules.networks import NETWORKS, Network
from lightning_modules.storage.pretrained import load_weights, read_weights


def configured_network(
    configs: Sequence[str] = (), weights: str | None = None, checkpoint: str | Path | None = None
) -> Network:
    """Build the network of configurations, weights or a checkpoint, and load its weights.

    Weights of a network of this package describe it; configurations then only replace the motion estimator. A
    checkpoint, in place of weights, has to match the network of the configurations, if they have one.
    """
    from jsonargparse import ArgumentError, ArgumentParser  # slow, and most predictions need no configuration

    chosen, named = None, weights
    parser = ArgumentParser(exit_on_error=False)
    parser.add_subclass_arguments(Network, "network", required=False)
    try:
        for config in configs:
            model = inner_arguments(read_config(config).get("model"))
            named = weights or model.get("weights") or named
            if model.get("network") is not None:
                chosen = parser.parse_object({"network": model["network"]}, namespace=chosen)
        source = checkpoint or named
        found = None if source is None else read_weights(source)
        described = None if chosen is None else parser.instantiate(chosen).network
        ours = found is not None and found.settings.get("class") in NETWORKS
        if ours and (described is None or checkpoint is None):
            own = chosen is not None and chosen.network.init_args.get("motion") is not None
            return Network.from_pretrained(source, described.motion if own else None)
        if described is None:
            got = "none" if found is None else f"those of {found.settings.get('class')}"
            expected = "expected weights of a network of this package, or -c that describes another"
            raise InputError(f"{source or '--weights'}: {expected}, got {got}")
        if found is not None:
            load_weights(described, found)
        elif any(True for _ in described.parameters()):
            raise UsageError(f"--weights, --ckpt_path: expected one of them for {type(described).__name__}, got none")
    except InputError:
        raise
    except (ArgumentError, OSError, ValueError) as error:
        raise InputError(reason(str(error))) from error
    return described.eval()


def checkpoint_of(asked: str | None, configs: Sequence[str], output: Path) -> Path | None:
    """Return the path of ``--ckpt_path``; best and last belong to the run of a configuration, or to ``output``."""
    if asked not in ("best", "last"):
        return None if asked is None else Path(asked).expanduser()
    said = [read_config(config).get("output") for config in configs]
    folders = [output, *(Path(str(folder)).expanduser() for folder in said if folder)]
    runs = [folder / "checkpoints" for folder in folders if (folder / "checkpoints").is_dir()]
    if not runs:
        where = " or ".join(str(folder / "checkpoints") for folder in folders)
        raise InputError(f"--ckpt_path {asked}: expected a run of lightning fit in {where}, got none")
    return run_checkpoint(runs[-1], asked)


def run_checkpoint(folder: Path, asked: str) -> Path:
    """Return the best or the last checkpoint of a run."""
    path = folder / f"{asked}.ckpt"
    if not path.is_file():
        there = sorted(other.name for other in folder.glob("*.ckpt"))
        why = "; a run that ended before its first validation has no best" if asked == "best" else ""
        raise InputError(f"{path}: no such checkpoint, there is {' and '.join(there) or 'none'}{why}")
    return path
