"""Photos are prepared side by side with the results and errors of one after the other."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from uika.assets import PORTRAIT
from uika.photo import PhotoError
from uika.reconstruction.fitted_photos import prepare_file, prepare_files


def test_several_photos_come_out_in_order_and_unchanged(tmp_path: Path) -> None:
    mirrored = tmp_path / "mirrored.png"
    Image.fromarray(np.asarray(Image.open(PORTRAIT).convert("RGB"))[:, ::-1].copy()).save(mirrored)
    together = prepare_files([PORTRAIT, mirrored])
    for found, path in zip(together, (PORTRAIT, mirrored), strict=True):
        alone = prepare_file(path)
        assert found.photo.sha256 == alone.photo.sha256
        assert torch.equal(found.photo.image, alone.photo.image) and torch.equal(found.hair, alone.hair)


def test_the_first_unusable_photo_is_named(tmp_path: Path) -> None:
    for name in ("b.png", "a.png"):
        Image.fromarray(np.full((80, 80, 3), 128, dtype=np.uint8)).save(tmp_path / name)
    with pytest.raises(PhotoError, match=r"b\.png"):
        prepare_files([tmp_path / "b.png", PORTRAIT, tmp_path / "a.png"])
