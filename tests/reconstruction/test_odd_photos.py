"""Photos that hardly anyone would choose, made of the demo portrait: an avatar without monsters, or one sentence."""

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw

from uika.assets import PORTRAIT
from uika.avatar import Avatar
from uika.errors import UikaWarning
from uika.head import load_head
from uika.photo import Photo, prepare
from uika.reconstruction import reconstruct

REACH = 0.12  # metres from the surface that hats and collars may stand off


@pytest.fixture(scope="module")
def portrait() -> tuple[Image.Image, np.ndarray, np.ndarray]:
    """The portrait, its landmarks [478,2] and its matte [H,W] in [0,1], both in its own pixels."""
    photo: Photo = prepare(PORTRAIT)
    image = Image.open(PORTRAIT).convert("RGB")
    x0, y0, side = photo.crop
    scale = side / photo.matte.shape[-1]
    marks = photo.landmarks.double().numpy() * scale + [x0, y0]
    row, column = np.mgrid[: image.height, : image.width]
    place = np.stack(((row - y0) / scale, (column - x0) / scale)).astype(int)
    inside = ((place >= 0) & (place < photo.matte.shape[-1])).all(0)
    matte = np.zeros(inside.shape)
    matte[inside] = photo.matte.numpy()[place[0][inside], place[1][inside]]
    return image, marks, matte


def two_people(image: Image.Image, marks: np.ndarray, matte: np.ndarray) -> Image.Image:
    both = Image.new("RGB", (2 * image.width, image.height), (120, 120, 120))
    other = image.resize((image.width * 4 // 5, image.height * 4 // 5)).transpose(Image.Transpose.FLIP_LEFT_RIGHT)
    both.paste(other, (image.width, image.height - other.height))
    both.paste(image, (0, 0))
    return both


def cut_at_the_chin(image: Image.Image, marks: np.ndarray, matte: np.ndarray) -> Image.Image:
    return image.crop((0, 0, image.width, int(marks[152, 1]) + 2))


def hat(image: Image.Image, marks: np.ndarray, matte: np.ndarray) -> Image.Image:
    worn = image.copy()
    (x, y), high = marks[10], marks[152, 1] - marks[10, 1]
    draw = ImageDraw.Draw(worn)
    draw.ellipse((x - 1.3 * high, y - 0.35 * high, x + 1.3 * high, y + 0.15 * high), fill=(60, 80, 40))
    draw.rectangle((x - 0.7 * high, y - high, x + 0.7 * high, y - 0.1 * high), fill=(60, 80, 40))
    return worn


def cutout_without_shoulders(image: Image.Image, marks: np.ndarray, matte: np.ndarray) -> Image.Image:
    alpha = matte.copy()
    alpha[int(marks[152, 1]) + 4 :] = 0
    return Image.fromarray(np.dstack((np.asarray(image), (255 * alpha).astype(np.uint8))))


def torn_matte(image: Image.Image, marks: np.ndarray, matte: np.ndarray) -> Image.Image:
    row, column = np.mgrid[: image.height, : image.width]
    high = marks[152, 1] - marks[10, 1]
    alpha, random = matte.copy(), np.random.default_rng(0)
    for _ in range(40):
        x, y = marks[10] + random.uniform(-1.5, 1.5, 2) * high
        # Eyes and mouth stay.
        hole = (np.hypot(column - x, row - y) < random.uniform(0.03, 0.1) * high) & (row < marks[10, 1])
        alpha[hole] = random.choice([0.0, 0.5])
    return Image.fromarray(np.dstack((np.asarray(image), (255 * alpha).astype(np.uint8))))


def strip(image: Image.Image, marks: np.ndarray, matte: np.ndarray) -> Image.Image:
    top = int(marks[10, 1] - 0.15 * (marks[152, 1] - marks[10, 1]))
    return image.crop((0, top, image.width, top + image.width // 3))


def standing_off(avatar: Avatar) -> float:
    """How far in metres 99.5 % of the photo splats stay from the surface."""
    head = load_head()
    count = int(avatar.provenance["photo_splats"])
    surface = avatar.canonical_vertices(head)
    away = torch.cdist(avatar.means[len(avatar) - count :], surface).amin(1)
    return float(away.quantile(0.995)) if count else 0.0


@pytest.mark.slow
@pytest.mark.parametrize("change", [two_people, cut_at_the_chin, hat, cutout_without_shoulders, torn_matte, strip])
def test_an_avatar_without_monsters(
    change: Callable[..., Image.Image],
    portrait: tuple[Image.Image, np.ndarray, np.ndarray],
    tmp_path: Path,
) -> None:
    path = tmp_path / f"{change.__name__}.png"
    change(*portrait).save(path)
    avatar = reconstruct([path]).avatar
    assert all(getattr(avatar, name).isfinite().all() for name in ("means", "scales", "opacities", "colors"))
    assert standing_off(avatar) < REACH


@pytest.mark.slow
def test_a_covered_face_is_spoken_of(portrait: tuple[Image.Image, np.ndarray, np.ndarray], tmp_path: Path) -> None:
    image, marks, _ = portrait
    masked = image.copy()
    jaw = (234, 93, 132, 58, 172, 136, 150, 149, 176, 148, 152, 377, 400, 378, 379, 365, 397, 288, 361, 323, 454, 6)
    ImageDraw.Draw(masked).polygon([tuple(marks[k]) for k in jaw], fill=(150, 190, 210))
    masked.save(tmp_path / "mask.png")
    with pytest.warns(UikaWarning, match="hardly looks like a person's"):
        prepare(tmp_path / "mask.png")


@pytest.mark.slow
def test_a_face_of_150_pixels_is_enough(portrait: tuple[Image.Image, np.ndarray, np.ndarray], tmp_path: Path) -> None:
    image, marks, _ = portrait
    scale = 150 / (2 * float(np.ptp(marks, axis=0).max()))
    image.resize((round(image.width * scale), round(image.height * scale))).save(tmp_path / "small.png")
    with warnings.catch_warnings():
        warnings.simplefilter("error", UikaWarning)
        assert standing_off(reconstruct([tmp_path / "small.png"]).avatar) < REACH
