"""Pictures of the validation during training."""

from types import SimpleNamespace

import numpy as np
import torch
from pytorch_lightning.loggers import TensorBoardLogger

from lightning_modules.tasks.callbacks import ValidationPictures


class Numbered(ValidationPictures):
    def rows(self, module, outputs, batch):
        return [[output.new_full((3, 4, 6), output.item())] for output in outputs]


def test_first_four_validation_clips_are_shown(monkeypatch, tmp_path):
    shown = []
    logger = TensorBoardLogger(tmp_path)
    monkeypatch.setattr(logger.experiment, "add_image", lambda *seen: shown.append(seen))
    trainer = SimpleNamespace(logger=logger, is_global_zero=True, global_step=7)
    pictures = Numbered()
    for _ in range(2):  # the second validation begins anew
        for batch in torch.arange(1, 10).div(10).split(3):
            pictures.on_validation_batch_end(trainer, None, batch, {})
        pictures.on_validation_epoch_end(trainer, None)
    assert [(title, step) for title, _, step in shown] == [("val/tfi, result, truth", 7)] * 2
    for _, picture, _ in shown:
        values = {round(float(value), 4) for value in np.unique(picture)}
        assert values - {1.0} == {0.1, 0.2, 0.3, 0.4}
