"""What colours decide in a trimap, on made-up pictures."""

import numpy as np
import pytest

from uika.photo.color_evidence import decided

SIZE = 200
WALL, HAIR, SKIN = (230, 190, 30), (90, 60, 40), (210, 160, 130)


def person(wall: tuple[int, int, int] = WALL, hair: tuple[int, int, int] = HAIR) -> tuple[np.ndarray, np.ndarray]:
    """A face among hair before a wall [S,S,3], noisy, and where the person is [S,S]."""
    row, column = np.mgrid[:SIZE, :SIZE]
    distance = np.hypot(row - 100, column - 100)
    image = np.full((SIZE, SIZE, 3), wall, dtype=np.float64)
    image[distance < 70] = hair
    image[distance < 35] = SKIN
    noise = np.random.default_rng(0).normal(0, 4, image.shape)
    return (image + noise).clip(0, 255).astype(np.uint8), distance < 70


def trimap(shape: np.ndarray) -> np.ndarray:
    from scipy.ndimage import binary_dilation, binary_erosion

    return np.where(binary_erosion(shape, iterations=6), 1.0, np.where(binary_dilation(shape, iterations=10), 0.5, 0.0))


def run(image: np.ndarray, shape: np.ndarray) -> np.ndarray:
    row, column = np.mgrid[:SIZE, :SIZE]
    sure = np.hypot(row - 100, column - 100) < 30
    return decided(trimap(shape), image, shape.astype(np.float32), sure, np.ones((SIZE, SIZE), np.float32))


def test_background_that_the_segmentation_took_for_the_person_is_none() -> None:
    image, shape = person()
    bay = np.zeros_like(shape)
    bay[90:112, 30:52] = True
    image[bay] = np.array(WALL)
    known = run(image, shape)
    assert (known[93:109, 34:48] == 0).all()
    assert (known[60:80, 80:120] == 1).all()


def test_the_uncertain_band_narrows_to_the_outline() -> None:
    image, shape = person()
    before, after = trimap(shape), run(image, shape)
    assert (after == 0.5).mean() < 0.5 * (before == 0.5).mean()
    assert (after[~shape] < 1).all() and (after[shape] > 0).mean() > 0.995


def test_hair_beyond_the_segmentation_is_found() -> None:
    image, shape = person()
    tail = np.zeros_like(shape)
    tail[120:160, 160:172] = True
    image[tail] = np.array(HAIR)
    known = trimap(shape)
    known[110:170, 150:182] = np.maximum(known[110:170, 150:182], 0.5)
    rough = np.where(shape, 1.0, np.where(tail, 0.6, 0.0)).astype(np.float32)
    found = decided(known, image, rough, np.hypot(*(np.mgrid[:SIZE, :SIZE] - 100)) < 30, np.ones_like(rough))
    assert (found[126:154, 164:168] == 1).all()


@pytest.mark.parametrize("wall", [HAIR, (40, 35, 30)])
def test_a_wall_like_the_hair_decides_nothing_against_the_person(wall: tuple[int, int, int]) -> None:
    image, shape = person(wall, wall)
    known = run(image, shape)
    assert (known[trimap(shape) == 1] == 1).all()


def test_what_lies_beyond_the_photo_is_left_alone() -> None:
    image, shape = person()
    inside = np.ones((SIZE, SIZE), np.float32)
    inside[:45] = 0
    image[:45] = image[45]
    known = decided(trimap(shape), image, shape.astype(np.float32), np.zeros_like(shape), inside)
    assert (known[:40] == trimap(shape)[:40]).all()
