import numpy as np
import pytest

from uika.photo.closed_form import solve_alpha
from uika.photo.foreground import estimate_foreground
from uika.photo.matte import solve, trimap


def ramp(size: int, wobble: float = 0.0) -> np.ndarray:
    """Matte that rises from 0 to 1 over the middle half, its edge wavy."""
    rows, columns = np.mgrid[:size, :size] / size
    return np.clip((columns + wobble * np.sin(9 * rows) - 0.25) * 2, 0, 1)


def known_from(alpha: np.ndarray) -> np.ndarray:
    return np.where(alpha <= 0, 0.0, np.where(alpha >= 1, 1.0, 0.5))


@pytest.mark.parametrize("wobble", [0.0, 0.1])
def test_two_colours_give_back_their_matte(wobble: float) -> None:
    alpha = ramp(64, wobble)[..., None]
    image = alpha * [0.8, 0.5, 0.2] + (1 - alpha) * [0.1, 0.3, 0.6]
    solved = solve_alpha(image, known_from(alpha[..., 0]))
    np.testing.assert_allclose(solved, alpha[..., 0], atol=2e-3)


def test_colour_lines_give_back_their_matte() -> None:
    """Foreground and background that each shift along one colour direction fulfil the method's assumption."""
    alpha = ramp(48, 0.1)[..., None]
    shade = np.linspace(0, 0.2, 48)[:, None, None]
    image = alpha * (np.array([0.7, 0.4, 0.1]) + shade) + (1 - alpha) * (np.array([0.1, 0.2, 0.7]) + shade)
    np.testing.assert_allclose(solve_alpha(image, known_from(alpha[..., 0])), alpha[..., 0], atol=0.02)


def test_solution_is_the_minimum_of_the_energy() -> None:
    """A dense Laplacian, built pixel pair by pixel pair from the paper's formula, has no descent direction left."""
    size, epsilon = 7, 1e-6
    image = np.random.default_rng(0).random((size, size, 3))
    laplacian = np.zeros((size, size, size, size))
    for row in range(1, size - 1):
        for column in range(1, size - 1):
            window = [(row + down, column + right) for down in (-1, 0, 1) for right in (-1, 0, 1)]
            colours = np.array([image[pixel] for pixel in window])
            mean = colours.mean(axis=0)
            inverse = np.linalg.inv(np.cov(colours.T, bias=True) + epsilon / 9 * np.eye(3))
            for first in window:
                for second in window:
                    affinity = 1 + (image[first] - mean) @ inverse @ (image[second] - mean)
                    laplacian[first + second] += (first == second) - affinity / 9
    known = np.full((size, size), 0.5)
    known[0], known[-1] = 0.0, 1.0
    free = (known == 0.5).ravel()
    dense = laplacian.reshape(size**2, size**2)
    expected = np.linalg.solve(dense[np.ix_(free, free)], -dense[np.ix_(free, ~free)] @ known.ravel()[~free])
    assert expected.std() > 0.05
    np.testing.assert_allclose(solve_alpha(image, known).ravel()[free], expected.clip(0, 1), atol=1e-4)


@pytest.mark.parametrize("level", [0, 128, 255])
def test_flat_image_is_solved(level: int) -> None:
    known = np.full((64, 64), 0.5)
    known[:8], known[-8:] = 1.0, 0.0
    matte = solve(np.full((64, 64, 3), level, dtype=np.uint8), known)
    assert np.isfinite(matte).all()
    assert (np.diff(matte.mean(axis=1)) <= 1e-4).all()


def test_nothing_to_decide_returns_the_trimap() -> None:
    known = np.ones((32, 32))
    known[:16] = 0
    np.testing.assert_array_equal(solve(np.zeros((32, 32, 3), dtype=np.uint8), known), known)


def test_large_matte_agrees_with_the_small_one() -> None:
    alpha = ramp(1024, 0.05)
    image = np.round(255 * (alpha[..., None] * [0.8, 0.5, 0.2] + (1 - alpha[..., None]) * [0.1, 0.3, 0.6]))
    solved = solve(image.astype(np.uint8), known_from(alpha))
    assert solved.shape == (1024, 1024)
    assert np.abs(solved - alpha).mean() < 0.02


def test_foreground_loses_the_background() -> None:
    size = 96
    alpha = ramp(size, 0.1).astype(np.float32)[..., None]
    front, back = np.float32([0.7, 0.5, 0.2]), np.float32([0.9, 0.1, 0.8])
    image = (alpha * front + (1 - alpha) * back).astype(np.float32)
    found = estimate_foreground(image, alpha[..., 0])
    assert found.shape == image.shape and found.dtype == np.float32
    some = alpha[..., 0] > 0.1
    assert np.abs(found - front)[some].mean() < 0.03
    assert np.abs(image - front)[some].mean() > 0.1


def test_trimap_keeps_only_the_person_of_the_face() -> None:
    rough = np.zeros((100, 100), dtype=np.float32)
    rough[20:90, 10:50] = 1.0
    rough[40:60, 25:35] = 0.3  # a hole in the middle of the person
    rough[20:90, 70:95] = 1.0  # someone else
    sure = np.zeros((100, 100), dtype=bool)
    sure[30:35, 25:35] = True
    known = trimap(rough, sure)
    assert set(np.unique(known)) == {0.0, 0.5, 1.0}
    assert (known[30:80, 75:90] == 0).all()
    assert known[50, 30] == 1
    assert known[50, 10] == 0.5 and known[50, 8] == 0.5
    assert known[5, 5] == 0
