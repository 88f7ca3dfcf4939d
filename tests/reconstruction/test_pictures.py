"""Pictures that no camera took: the portrait as flat colours, brush strokes and a pencil drawing."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter, ImageOps

from uika.assets import PORTRAIT
from uika.photo import prepare
from uika.photo.crop import to_photo


def cartoon(image: Image.Image) -> Image.Image:
    """Few flat colours within dark outlines."""
    flat = image.filter(ImageFilter.ModeFilter(9)).quantize(12).convert("RGB")
    edges = ImageOps.invert(image.convert("L").filter(ImageFilter.GaussianBlur(2)).filter(ImageFilter.FIND_EDGES))
    dark = np.asarray(edges.point(lambda level: 255 if level > 235 else 90), np.float32)[..., None] / 255
    return Image.fromarray((np.asarray(flat) * dark).astype(np.uint8))


def painting(image: Image.Image) -> Image.Image:
    """Brush strokes: each stroke takes the colour of its middle."""
    strokes = image.resize((image.width // 5, image.height // 5)).filter(ImageFilter.ModeFilter(3))
    warm = np.asarray(strokes.resize(image.size, Image.Resampling.NEAREST), np.float32) * (1.05, 0.98, 0.85)
    return Image.fromarray(warm.clip(0, 255).astype(np.uint8)).filter(ImageFilter.GaussianBlur(1.5))


def pencil(image: Image.Image) -> Image.Image:
    """Grey lines on white paper."""
    grey = np.asarray(image.convert("L"), np.float32)
    soft = np.asarray(ImageOps.invert(image.convert("L")).filter(ImageFilter.GaussianBlur(12)), np.float32)
    return Image.fromarray((grey * 255 / (256 - soft).clip(1)).clip(0, 255).astype(np.uint8)).convert("RGB")


@pytest.mark.filterwarnings("ignore:.*hardly looks like a person's:uika.errors.UikaWarning")
@pytest.mark.parametrize("draw", [cartoon, painting, pencil])
def test_drawn_faces_are_found_and_cut_out(draw, tmp_path: Path) -> None:
    photo = ImageOps.exif_transpose(Image.open(PORTRAIT)).convert("RGB")
    photo.thumbnail((900, 900))
    draw(photo).save(tmp_path / "drawn.png")
    drawn = prepare(tmp_path / "drawn.png")
    photo.save(tmp_path / "photo.png")
    real = prepare(tmp_path / "photo.png")
    places = [to_photo(each.landmarks.double().numpy(), each.crop, 512) for each in (drawn, real)]
    eyes = np.linalg.norm(places[1][33] - places[1][263])
    assert np.linalg.norm(places[0] - places[1], axis=1).mean() < 0.15 * eyes
    assert 0.2 < float(drawn.matte.mean()) < 0.8


@pytest.mark.slow
@pytest.mark.parametrize("draw", [cartoon, painting])
def test_drawn_faces_become_avatars(draw, tmp_path: Path) -> None:
    from uika.cli import main

    photo = ImageOps.exif_transpose(Image.open(PORTRAIT)).convert("RGB")
    photo.thumbnail((900, 900))
    draw(photo).save(tmp_path / "drawn.png")
    assert main(["reconstruct", str(tmp_path / "drawn.png"), "-o", str(tmp_path / "a.safetensors")]) == 0
    assert main(["render", str(tmp_path / "a.safetensors"), "-o", str(tmp_path / "a.png"), "--size", "256"]) == 0
