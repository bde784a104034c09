"""What ``lightning predict`` writes: a picture for every clip, and the film that they are."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
from pytorch_lightning import Callback, LightningModule, Trainer
from pytorch_lightning.callbacks import ProgressBar
from torch import Tensor, nn

from lightning_modules.networks import ClassicalDecoder, TwoSpanCSCSR
from spikekit import write_video
from spikekit.io.failures import writing
from spikekit.io.image_bytes import PictureError, png_bytes, png_notes, png_pixels, to_bytes
from spikekit.io.video import VIDEO_ENDINGS
from spikekit.io.whole_file import whole_file
from spikekit.progress import progress

_NOTE = "spikekit"
_GAP = 4  # white pixels between two pictures
_PARTS = "reading", "motion", "network", "writing"


def is_film(output: str | Path) -> bool:
    """Whether this names a film rather than a folder of pictures."""
    return Path(output).suffix.lower() in (*VIDEO_ENDINGS, ".gif") and not Path(output).is_dir()


def is_picture(output: str | Path) -> bool:
    """Whether this names a single picture rather than a folder of them."""
    return Path(output).suffix.lower() == ".png" and not Path(output).is_dir()


def pictures_folder(output: str | Path) -> Path:
    """Return the folder of the pictures: of a film or a picture, one beside it, which goes when that is whole."""
    return Path(f"{output}.frames") if is_film(output) or is_picture(output) else Path(output)


class Predictions(Callback):
    """Write every predicted picture as PNG, and lay them one after the other where a film is asked for.

    A picture is named after the spike frame that it shows, appears when it is whole, and says of what it was made. What
    is there already, made of the same, is not made again: a run that was killed goes on behind its last picture.

    Args:
        output: a folder, or a film: .mp4, .mov, .mkv or .gif, whose pictures lie in a folder beside it until they are
            complete; or a .png, where there is one clip.
        made_of: settings of the pictures, as plain values; pictures are made again whatever is there when not given.
        fps: pictures shown in a second of the film.
        beside: ``"tfi"`` or ``"tfp"`` shows what this decoder makes of the same clip left of every picture.
        part: which part of the pictures is made here, counted from 0, and of how many; of one alone there is a film.
    """

    def __init__(
        self,
        output: str | Path,
        made_of: dict[str, Any] | None = None,
        fps: float = 25.0,
        beside: str | None = None,
        part: tuple[int, int] = (0, 1),
    ) -> None:
        self.output = Path(output)
        self.folder = pictures_folder(output)
        self.made_of = made_of
        self.fps = fps
        self.beside = beside
        self.part = part

    def setup(self, trainer: Trainer, module: LightningModule, stage: str) -> None:  # noqa: D102
        clips = trainer.datamodule.clips
        clips.part = self.part
        self._file, self._white, self._written = self.folder != self.output and self.part[1] == 1, clips.white, 0
        self._made = 0  # with those that a network sees again, and nobody is shown
        self._paths = {frame: self.folder / f"frame_{frame:06d}.png" for frame in clips.chosen}
        self._notes = {}
        if self.made_of is not None:
            made_of = {**self.made_of, "beside": self.beside, "white": self._white, "network": _digest(module)}
            made_of["recording"] = file_identity(clips.recording.path)
            self._notes[_NOTE] = hashlib.sha256(json.dumps(made_of, sort_keys=True, default=str).encode()).hexdigest()
            if trainer.strategy.broadcast(self._notes) != self._notes:  # each has tried its machine for a --budget
                raise PictureError(f"{self.output}: expected all processes to use the same weights; name them")
            clips.made = {frame for frame, path in self._paths.items() if self._is_there(path)}

    def _is_there(self, path: Path) -> bool:
        return png_notes(path).items() >= self._notes.items()

    def on_predict_start(self, trainer: Trainer, module: LightningModule) -> None:  # noqa: D102
        self._watch = Stopwatch(module.device)
        motion = getattr(module.network, "motion", nn.Identity())
        self._hooks = [
            motion.register_forward_pre_hook(lambda *_: self._watch.lap("network")),
            motion.register_forward_hook(lambda *_: self._watch.lap("motion")),
        ]
        self._shares: list[float] = []
        if isinstance(module.network, TwoSpanCSCSR):
            note = module.network.share_of_long.register_forward_hook
            self._hooks.append(note(lambda *seen: self._shares.append(seen[-1].mean().item())))

    def on_predict_batch_start(self, *_: Any) -> None:  # noqa: D102
        self._watch.lap("reading")

    def on_predict_batch_end(  # noqa: D102
        self, trainer: Trainer, module: LightningModule, outputs: Tensor, batch: dict[str, Tensor], *_: Any
    ) -> None:
        self._watch.lap("network")
        self._made += len(outputs)
        show = trainer.datamodule.show
        for n, (rgb, frame) in enumerate(zip(outputs, batch["frame"].tolist(), strict=True)):
            if not batch["shown"][n]:
                continue
            path = self._paths[frame]
            if not rgb.isfinite().all():  # it would be black there, and nothing would say why
                raise PictureError(
                    f"{path}: expected a picture, the network makes NaN of this clip; nothing is written"
                )
            shown = to_bytes(show(rgb))  # (H, W, 3), a quarter of the memory
            if self.beside:
                decoded = to_bytes(show(self._decoded(module, batch, n)))
                shown = torch.cat([decoded, shown.new_full((len(shown), _GAP, 3), 255), shown], dim=1)
            with writing(path, PictureError), whole_file(path) as file:
                file.write(png_bytes(shown.movedim(-1, 0), self._notes))
            self._written += 1
        self._watch.lap("writing")

    def _decoded(self, module: LightningModule, batch: dict[str, Tensor], n: int) -> Tensor:
        settings = module.network.settings
        decoder = ClassicalDecoder(self.beside, settings["scale"], settings["pattern"], batch["white"][n].item())
        return decoder(batch["spikes"][n : n + 1])[0].clamp(0, 1)

    def on_predict_end(self, trainer: Trainer, module: LightningModule) -> None:  # noqa: D102
        for hook in self._hooks:
            hook.remove()

    def teardown(self, trainer: Trainer, module: LightningModule, stage: str) -> None:
        """Say what was written, and lay the pictures to a film; here, as nothing is predicted where all are there."""
        trainer.strategy.barrier("pictures")
        if not trainer.is_global_zero:
            return
        lacking = [path for path in self._paths.values() if not self._is_there(path)]
        there, total = len(self._paths) - len(lacking), len(self._paths)
        if self._file and not lacking:
            if is_film(self.output):
                pictures = (png_pixels(path) for path in self._paths.values())
                write_video(self.output, progress(pictures, "film", total), self.fps)
            else:
                (path,) = self._paths.values()
                path.replace(self.output)
            shutil.rmtree(self.folder, ignore_errors=True)
        count = f"{there} of {total}" if lacking else total
        count = f"{count} {'picture' if total == 1 else 'pictures'}"
        made = f", {self._written} of them new" if self._written < there and trainer.world_size == 1 else ""
        print(f"{self.output}: {count}{made}, {self._white:.4g} spikes a frame are white")  # noqa: T201
        if self._made:
            print(self._watch.said(self._made))  # noqa: T201
            if self._shares:
                share, network = sum(self._shares) / len(self._shares), module.network
                spans = f"{network.long.frames} frames, the faster rest of {network.short.frames}"
                print(f"{share:.0%} of the pictures are of clips of {spans}")  # noqa: T201


class PictureProgress(ProgressBar):
    """How many pictures are made and how far the present one is, each with the time that is left."""

    def __init__(self) -> None:
        super().__init__()
        self._hidden: bool | None = None  # None: shown on a terminal

    def disable(self) -> None:  # noqa: D102
        self._hidden = True

    def on_predict_start(self, trainer: Trainer, module: LightningModule) -> None:  # noqa: D102
        total = sum(trainer.num_predict_batches)
        self._pictures = progress(what="pictures", total=total, unit="picture", delay=0, disable=self._hidden)

    def on_predict_batch_start(self, trainer: Trainer, module: LightningModule, *_: Any) -> None:  # noqa: D102
        shown = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}, {remaining} left"
        part = progress(what="this picture", total=1.0, position=1, disable=self._hidden, bar_format=shown)
        module.done = lambda share: part.update(share - part.n)
        self._part = part

    def on_predict_batch_end(self, *_: Any) -> None:  # noqa: D102
        self._part.close()
        self._pictures.update()

    def on_predict_end(self, trainer: Trainer, module: LightningModule) -> None:  # noqa: D102
        self._pictures.close()
        module.done = None


class Stopwatch:
    """Time by parts that follow each other.

    Args:
        device: whose work is waited for.
    """

    def __init__(self, device: torch.device) -> None:
        self._wait = partial(torch.cuda.synchronize, device) if device.type == "cuda" else lambda: None
        self.seconds: dict[str, float] = defaultdict(float)
        self._since = time.perf_counter()

    def lap(self, part: str) -> None:
        """Count what has passed since the last time as a part's."""
        self._wait()
        now = time.perf_counter()
        self.seconds[part] += now - self._since
        self._since = now

    def said(self, frames: int) -> str:
        """Return the time of a frame, and of its parts, in words."""
        parts = ", ".join(f"{part} {self.seconds[part] / frames:.3g} s" for part in _PARTS)
        return f"{sum(self.seconds.values()) / frames:.3g} s a frame: {parts}"


def file_identity(path: str | Path) -> list[Any]:
    """Return what tells a file from another, and from itself after it has changed."""
    path = Path(path).resolve()
    return [str(path), path.stat().st_size, path.stat().st_mtime_ns]


def _digest(module: LightningModule) -> str:
    """Return a number that all weights of a module have a share in."""
    total = hashlib.sha256()
    for name, value in module.network.state_dict().items():
        total.update(name.encode())
        total.update(value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy())
    return total.hexdigest()
