import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from uika.photo import Photo, PhotoError, head_matte, prepare

SIZE = 192
FACE_HEIGHT = 108  # pixels, in the portrait file


def landmarks_in_photo(photo: Photo) -> torch.Tensor:
    x0, y0, side = photo.crop
    return photo.landmarks * (side / photo.image.shape[-1]) + torch.tensor([x0, y0])


def rerun(tmp_path: Path, image: Image.Image, **options: object) -> Photo:
    path = tmp_path / "variant.png"
    image.save(path, **options)
    return prepare(path, SIZE)


@pytest.fixture(scope="module")
def image(portrait_path: Path) -> Image.Image:
    return Image.open(portrait_path).convert("RGB")


@pytest.fixture(scope="module")
def small(portrait_path: Path) -> Photo:
    return prepare(portrait_path, SIZE)


def test_shapes_and_ranges(portrait: Photo, portrait_path: Path) -> None:
    assert portrait.image.shape == portrait.original.shape == (3, 512, 512)
    assert portrait.matte.shape == (512, 512)
    assert portrait.landmarks.shape == (478, 2)
    assert portrait.path == str(portrait_path)
    for name in ("image", "original", "matte"):
        values = getattr(portrait, name)
        assert values.dtype == torch.float32
        assert values.min() >= 0 and values.max() <= 1


def test_landmarks_lie_on_the_face(portrait: Photo) -> None:
    points = portrait.landmarks
    assert points.min() > 0 and points.max() < 512
    right_iris, left_iris, mouth, chin = points[468], points[473], points[13], points[152]
    assert right_iris[0] < left_iris[0]
    assert max(right_iris[1], left_iris[1]) < mouth[1] < chin[1]
    for iris in (right_iris, left_iris):  # the darkest spot of the eye, not skin
        column, row = (int(value) for value in iris)
        assert portrait.original[:, row - 2 : row + 3, column - 2 : column + 3].mean() < 0.3


def test_crop_holds_hair_and_neck(portrait: Photo) -> None:
    rows = torch.nonzero(portrait.matte.amax(dim=1) > 0.5)
    assert 30 < rows.min() < 130
    assert portrait.landmarks[152, 1] < 512 - 60
    assert portrait.matte[:400, 0].max() == 0 and portrait.matte[:400, -1].max() == 0


def test_matte_separates_hair_from_background(portrait: Photo) -> None:
    assert 0.35 < portrait.matte.mean() < 0.55
    for column, row in ((280, 110), (115, 210), (395, 230), (245, 415)):  # hair on three sides, chin
        assert portrait.matte[row, column] > 0.9
    for column, row in ((60, 150), (450, 300), (345, 355)):
        assert portrait.matte[row, column] < 0.05
    soft = ((portrait.matte > 0.02) & (portrait.matte < 0.98)).float().mean()
    assert 0.005 < soft < 0.12


def test_outside_the_photo_is_background(portrait: Photo) -> None:
    _, y0, side = portrait.crop
    outside = int(-y0 * 512 / side)
    assert outside > 20
    assert portrait.matte[:outside].max() == 0
    assert portrait.original[:, :outside].min() == 1 and portrait.image[:, :outside].min() == 1


def test_composite_keeps_no_old_background(portrait_path: Path) -> None:
    """On green, half-covered pixels must mix hair and green, not the photo's light grey wall and green."""
    photo = prepare(portrait_path, SIZE, background=(0.0, 1.0, 0.0))
    edge = (photo.matte > 0.2) & (photo.matte < 0.8)
    edge[int(0.6 * SIZE) :] = False
    assert edge.sum() > 50
    red, blue = photo.image[0][edge], photo.image[2][edge]
    alpha = photo.matte[edge]
    assert (red / alpha).mean() < 0.62 and (blue / alpha).mean() < 0.5
    nothing = photo.matte == 0
    assert photo.image[1][nothing].min() == 1 and photo.image[0][nothing].max() == 0


def test_head_matte_leaves_the_torso(portrait: Photo) -> None:
    head = head_matte(portrait)
    assert (head <= portrait.matte).all()
    for column, row in ((280, 110), (115, 210), (395, 230), (245, 415)):
        assert head[row, column] > 0.9
    for column, row in ((250, 445), (90, 390), (360, 470)):
        assert head[row, column] < 0.05
        assert portrait.matte[row, column] > 0.9


def test_same_file_same_result(small: Photo, portrait_path: Path) -> None:
    again = prepare(portrait_path, SIZE)
    for field in fields(Photo):
        first, second = getattr(small, field.name), getattr(again, field.name)
        assert torch.equal(first, second) if isinstance(first, torch.Tensor) else first == second


def test_lossless_copy_and_exif_rotation_agree(tmp_path: Path, small: Photo, image: Image.Image) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    turned = rerun(tmp_path, image.transpose(Image.Transpose.ROTATE_90), exif=exif)
    assert turned.sha256 != small.sha256
    assert torch.equal(turned.landmarks, small.landmarks)
    assert torch.equal(turned.image, small.image)


def test_grey_photo_agrees(tmp_path: Path, small: Photo, image: Image.Image) -> None:
    grey = rerun(tmp_path, image.convert("L"))
    distance = (landmarks_in_photo(grey) - landmarks_in_photo(small)).norm(dim=1)
    assert distance.mean() < 0.015 * FACE_HEIGHT
    assert torch.equal(grey.original[0], grey.original[2])


def test_alpha_around_the_person_is_the_matte(tmp_path: Path, image: Image.Image, small: Photo) -> None:
    canvas = np.zeros((512, 512), dtype=np.uint8)
    canvas[10:, 140:310] = 255  # a cut far coarser than the estimate
    cut = image.copy()
    cut.putalpha(Image.fromarray(canvas))
    photo = rerun(tmp_path, cut)
    x0, y0, side = photo.crop
    column, row = (int((at - start) * SIZE / side) for at, start in ((150, x0), (100, y0)))
    assert photo.matte[row, column] == 1  # background kept by the file's own alpha
    assert photo.matte[:, 2].max() == 0
    distance = (landmarks_in_photo(photo) - landmarks_in_photo(small)).norm(dim=1)
    assert distance.mean() < 0.015 * FACE_HEIGHT


def test_alpha_with_rounded_corners_is_no_matte(tmp_path: Path, image: Image.Image, small: Photo) -> None:
    canvas = np.full((512, 512), 255, dtype=np.uint8)
    canvas[:20, :20] = 0
    framed = image.copy()
    framed.putalpha(Image.fromarray(canvas))
    photo = rerun(tmp_path, framed)
    assert (photo.matte - small.matte).abs().mean() < 0.01


def test_small_face_in_a_large_photo(tmp_path: Path, image: Image.Image, small: Photo) -> None:
    noise = Image.effect_noise((2400, 1800), 30).convert("RGB")
    noise.paste(image.resize((340, 340)), (1900, 1300))
    photo = rerun(tmp_path, noise)
    expected = landmarks_in_photo(small) * (340 / 512) + torch.tensor([1900.0, 1300.0])
    assert (landmarks_in_photo(photo) - expected).norm(dim=1).mean() < 0.02 * FACE_HEIGHT


def test_close_up(tmp_path: Path, image: Image.Image, small: Photo) -> None:
    box = (165, 60, 285, 190)
    photo = rerun(tmp_path, image.crop(box).resize((960, 1040)))
    expected = (landmarks_in_photo(small) - torch.tensor([165.0, 60.0])) * 8
    assert (landmarks_in_photo(photo) - expected).norm(dim=1).mean() < 0.02 * 8 * FACE_HEIGHT


def test_largest_of_two_faces_wins(tmp_path: Path, image: Image.Image, small: Photo) -> None:
    both = Image.new("RGB", (900, 512), (190, 185, 180))
    both.paste(image.crop((100, 0, 360, 512)).resize((130, 256)), (40, 100))
    both.paste(image, (388, 0))
    photo = rerun(tmp_path, both)
    expected = landmarks_in_photo(small) + torch.tensor([388.0, 0.0])
    assert (landmarks_in_photo(photo) - expected).norm(dim=1).mean() < 0.015 * FACE_HEIGHT


@pytest.mark.parametrize("picture", ["noise", "flat", "disc"])
def test_no_face(tmp_path: Path, picture: str) -> None:
    path = tmp_path / "empty-room.png"
    if picture == "noise":
        pixels = np.random.default_rng(0).integers(0, 255, (300, 400, 3), dtype=np.uint8)
    else:
        pixels = np.full((300, 400, 3), 128, dtype=np.uint8)
        rows, columns = np.mgrid[:300, :400]
        if picture == "disc":
            pixels[(rows - 150) ** 2 + (columns - 200) ** 2 < 100**2] = (220, 180, 160)
    Image.fromarray(pixels).save(path)
    with pytest.raises(PhotoError, match=r"empty-room\.png: shows no face"):
        prepare(path)


@pytest.mark.parametrize("size", [0, 63, 5000])
def test_size_out_of_range(portrait_path: Path, size: int) -> None:
    with pytest.raises(ValueError, match="size"):
        prepare(portrait_path, size)


@pytest.mark.parametrize("background", [(1.0, 1.0), (2.0, 0.0, 0.0), (float("nan"), 0.0, 0.0)])
def test_background_out_of_range(portrait_path: Path, background: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="background"):
        prepare(portrait_path, SIZE, background)  # type: ignore[arg-type]


def test_import_is_light_and_the_models_are_silent(portrait_path: Path) -> None:
    code = (
        "import sys, uika.photo\n"
        "assert not {'mediapipe', 'scipy', 'PIL'} & set(sys.modules)\n"
        f"uika.photo.prepare({str(portrait_path)!r}, 64)\n"
        "print('after', file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "after\n"
    assert done.stdout == ""
