from pathlib import Path

import numpy as np
import pytest

from scenes import read_exr, write_exr


def some_images() -> dict[str, np.ndarray]:
    generator = np.random.default_rng(0)
    shapes = {
        "rgb": (5, 7, 3),
        "mask": (5, 7),
        "depth": (5, 7),
        "uv": (5, 7, 2),
        "triangle": (5, 7),
        "normal": (5, 7, 3),
    }
    return {name: generator.standard_normal(shape).astype(np.float32) for name, shape in shapes.items()}


def test_images_survive_the_file_exactly(tmp_path: Path) -> None:
    images = some_images()
    write_exr(tmp_path / "frame.exr", images)
    read = read_exr(tmp_path / "frame.exr")
    assert set(read) == set(images)
    for name, image in images.items():
        np.testing.assert_array_equal(read[name], image)
    assert [path.name for path in tmp_path.iterdir()] == ["frame.exr"]


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    write_exr(tmp_path / "frame.exr", {"mask": np.ones((2, 2))})
    with pytest.raises(ValueError, match="same height and width"):
        write_exr(tmp_path / "frame.exr", {"mask": np.zeros((2, 2)), "depth": np.zeros((3, 2))})
    with pytest.raises(ValueError, match="'uv' has shape"):
        write_exr(tmp_path / "frame.exr", {"uv": np.zeros((2, 2, 3))})
    assert read_exr(tmp_path / "frame.exr")["mask"].min() == 1
    assert len(list(tmp_path.iterdir())) == 1


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "bad.exr").write_bytes(b"not an image")
    for name in ("bad.exr", "missing.exr"):
        with pytest.raises(ValueError, match=name):
            read_exr(tmp_path / name)
