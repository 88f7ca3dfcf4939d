from pathlib import Path

import numpy as np
import pytest
import torch

from uika.head import HeadError, HeadModel, load_head, save_arrays, save_head


@pytest.fixture
def saved(head: HeadModel, tmp_path: Path) -> Path:
    save_head(head, tmp_path / "head.npz")
    return tmp_path / "head.npz"


def rewrite(path: Path, **changes: np.ndarray | None) -> None:
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files if name != "sha256"}
    arrays.update({name: value for name, value in changes.items() if value is not None})
    save_arrays({name: value for name, value in arrays.items() if changes.get(name, 0) is not None}, path)


def test_a_head_survives_its_file(head: HeadModel, saved: Path) -> None:
    read = load_head(saved)
    assert read.id == head.id and read.expression_names == head.expression_names
    torch.testing.assert_close(read.template, head.template)
    torch.testing.assert_close(read.identity_basis, head.identity_basis, atol=1e-6, rtol=0)
    torch.testing.assert_close(read.lbs_weights, head.lbs_weights, atol=1e-3, rtol=0)
    torch.testing.assert_close(read.lbs_weights.sum(-1), torch.ones(len(head.template)))
    torch.testing.assert_close(read.masks["scalp"], head.masks["scalp"])
    assert torch.equal(read.uv_faces, head.uv_faces) and read.faces.dtype == torch.int64
    assert load_head(saved) is read


def test_environment_names_the_default_head(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UIKA_HEAD", str(saved))
    assert load_head().id == "synthetic-1"


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(HeadError, match=r"nothing\.npz does not exist"):
        load_head(tmp_path / "nothing.npz")


def test_truncated_file_is_refused(saved: Path) -> None:
    data = saved.read_bytes()
    for length in (0, 20, len(data) // 2, len(data) - 3):
        saved.write_bytes(data[:length])
        with pytest.raises(HeadError, match="cannot be read"):
            load_head(saved)


def test_pickled_arrays_are_refused(saved: Path) -> None:
    np.savez(saved, template=np.array([{"a": 1}], dtype=object))
    with pytest.raises(HeadError, match="cannot be read"):
        load_head(saved)


def test_edited_content_is_refused(saved: Path) -> None:
    with np.load(saved) as file:
        arrays = {name: file[name] for name in file.files}
    np.savez(saved, **(arrays | {"template": arrays["template"] + 1}))
    with pytest.raises(HeadError, match="sha256"):
        load_head(saved)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("joints", None, "lacks the array 'joints'"),
        ("joints", np.zeros((4, 3), np.float32), r"'joints' has shape \(4, 3\) where \(5, 3\)"),
        ("joints", np.full((5, 3), np.nan, np.float32), "'joints' holds values that are not finite"),
        ("uv_faces", np.zeros((1, 3), np.int32), "'uv_faces' has shape"),
        ("landmark_faces", np.array([0, 1, 9999]), "'landmark_faces' points outside"),
        ("faces", np.zeros((1, 3), np.float32), "'faces' must hold integers"),
    ],
)
def test_a_wrong_array_is_named(saved: Path, name: str, value: np.ndarray | None, message: str) -> None:
    rewrite(saved, **{name: value})
    with pytest.raises(HeadError, match=message):
        load_head(saved)


def test_to_changes_every_floating_tensor(head: HeadModel) -> None:
    double = head.to(torch.float64)
    assert double.template.dtype == double.masks["face"].dtype == torch.float64
    assert double.faces.dtype == torch.int64 and head.template.dtype == torch.float32
