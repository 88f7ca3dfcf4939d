"""Faces that do not stand upright: right landmarks, or a refusal that says how to turn the photo."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter

from tests.avatars import painted_avatar
from uika.errors import UikaWarning
from uika.head import load_head
from uika.photo import PhotoError, prepare
from uika.photo.detect import find_face
from uika.photo.trust import judge, turned_by
from uika.reconstruction.photos_to_avatar import with_doubts


@pytest.fixture(scope="module")
def image(portrait_path: Path) -> Image.Image:
    return Image.open(portrait_path).convert("RGB")


@pytest.fixture(scope="module")
def truth(image: Image.Image) -> np.ndarray:
    found = find_face(np.asarray(image))
    assert found is not None
    return found


def turned(image: Image.Image, truth: np.ndarray, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """The picture turned counterclockwise on a grey ground, and the landmarks in it."""
    other = image.rotate(degrees, Image.Resampling.BICUBIC, expand=True, fillcolor=(128, 128, 128))
    angle = np.deg2rad(degrees)
    matrix = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return np.asarray(other), (truth - np.array(image.size) / 2) @ matrix.T + np.array(other.size) / 2


@pytest.mark.parametrize("degrees", [0, 20, -35, 60, -75, 90, -90])
def test_leaning_faces_are_read(degrees: float, image: Image.Image, truth: np.ndarray) -> None:
    photo, want = turned(image, truth, degrees)
    found = find_face(photo)
    assert found is not None and turned_by(photo, found) == 0
    assert np.linalg.norm(found - want, axis=1).mean() < 0.03 * np.ptp(truth[:, 1])


@pytest.mark.parametrize("degrees", [120, 135, 150, 165, 180, 200, 225, -120])
def test_faces_on_their_head_are_refused(degrees: float, image: Image.Image, truth: np.ndarray, tmp_path: Path) -> None:
    Image.fromarray(turned(image, truth, degrees)[0]).save(tmp_path / "scan.png")
    with pytest.raises(PhotoError, match=r"scan\.png: .*upright"):
        prepare(tmp_path / "scan.png", 128)


@pytest.mark.parametrize("turn", ["ROTATE_180", "FLIP_TOP_BOTTOM"])
@pytest.mark.parametrize("scale", [0.75, 1.0, 2.0])
def test_how_to_turn_a_scan_is_said(turn: str, scale: float, image: Image.Image, tmp_path: Path) -> None:
    size = tuple(round(side * scale) for side in image.size)
    image.transpose(Image.Transpose[turn]).resize(size).save(tmp_path / "scan.jpg", quality=90)
    with pytest.raises(PhotoError, match=r"scan\.jpg: "):
        prepare(tmp_path / "scan.jpg", 128)


def spoiled(image: Image.Image, truth: np.ndarray, how: str, amount: float) -> tuple[np.ndarray, np.ndarray]:
    """The portrait blurred (pixels), covered or cut off on its right (shares of the face), or noisy (levels)."""
    low, high = truth.min(axis=0), truth.max(axis=0)
    edge = round(float(high[0] - amount * (high[0] - low[0])))
    if how == "blurred":
        return np.asarray(image.filter(ImageFilter.GaussianBlur(amount))), truth
    if how == "noisy":
        values = np.asarray(image) + np.random.default_rng(0).normal(0, amount, (*image.size[::-1], 3))
        return values.clip(0, 255).astype(np.uint8), truth
    if how == "cut off":
        return np.asarray(image)[:, :edge], truth
    other = np.array(image)
    other[int(low[1]) - 30 : int(high[1]) + 30, edge : int(high[0]) + 40] = 90
    return other, truth


@pytest.mark.parametrize(
    ("how", "amounts"),
    [
        ("blurred", (1, 2.5, 4, 5, 8)),
        ("noisy", (10, 30, 60, 100)),
        ("covered", (0.2, 0.4, 0.5, 0.6)),
        ("cut off", (0.1, 0.3, 0.45, 0.55)),
    ],
)
def test_spoiled_faces_are_right_or_refused(
    how: str, amounts: tuple[float, ...], image: Image.Image, truth: np.ndarray, tmp_path: Path
) -> None:
    refused = []
    for amount in amounts:
        photo, want = spoiled(image, truth, how, amount)
        found = find_face(photo)
        refused.append(found is None or bool(judge(photo, found).problem))
        if found is not None and not refused[-1]:
            assert np.linalg.norm(found - want, axis=1).mean() < 0.03 * np.ptp(truth[:, 1]), amount
    assert not refused[0] and refused[-1] and refused == sorted(refused)


@pytest.mark.parametrize("scores", [[0.8, 0.1, 0.2, 0.3], [1.1, 0.0, 0.0, 0.0], [0.9, 0.9, 0.9, 0.9]])
def test_faces_that_the_detectors_hardly_take_for_a_persons_are_spoken_of(
    scores: list[float], image: Image.Image, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("uika.photo.trust.face_scores", lambda _: scores)  # no animal's picture is kept here
    image.save(tmp_path / "dog.png")
    with pytest.warns(UikaWarning, match=r"dog\.png: its face hardly looks like a person's"):
        photo = prepare(tmp_path / "dog.png", 128)
    assert not photo.person
    made = with_doubts(painted_avatar(load_head(), 8), [photo])
    assert photo.sha256 in made.provenance["face"]


def test_a_person_is_nothing_to_speak_of(portrait_path: Path) -> None:
    photo = prepare(portrait_path, 128)
    avatar = painted_avatar(load_head(), 8)
    assert photo.person and with_doubts(avatar, [photo]) is avatar
