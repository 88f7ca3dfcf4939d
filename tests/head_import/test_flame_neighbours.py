"""FLAME files as newer tools write them, and those that are no FLAME files."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import sparse

from tests.flame_files import flame_arrays, write_obj
from uika.head import HeadError
from uika.head_import.flame_file import read_flame
from uika.head_import.unpickle import UnpickleError, read_arrays

KINDS = ("csc_matrix", "csr_matrix", "coo_matrix", "csc_array", "csr_array", "coo_array")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("protocol", [2, 4])
def test_sparse_arrays_of_any_scipy(kind: str, protocol: int, tmp_path: Path) -> None:
    dense = np.zeros((5, 40))
    dense[[0, 2, 4], [7, 0, 39]] = (0.25, 0.5, 1.0)
    (tmp_path / "m.pkl").write_bytes(pickle.dumps({"J_regressor": getattr(sparse, kind)(dense)}, protocol=protocol))
    np.testing.assert_array_equal(read_arrays(tmp_path / "m.pkl")["J_regressor"], dense)


@pytest.mark.parametrize("kind", ["bsr_array", "dia_matrix", "lil_array", "dok_matrix"])
def test_other_sparse_matrices_are_named(kind: str, tmp_path: Path) -> None:
    (tmp_path / "m.pkl").write_bytes(pickle.dumps({"J_regressor": getattr(sparse, kind)(np.eye(5, 40))}))
    with pytest.raises(UnpickleError, match=rf"m\.pkl: refers to .*{kind}"):
        read_arrays(tmp_path / "m.pkl")


@pytest.mark.parametrize("damage", ["short", "outside", "negative"])
def test_entries_that_do_not_fit_are_refused(damage: str, tmp_path: Path) -> None:
    matrix: Any = sparse.coo_matrix(np.eye(3))
    if damage == "short":
        matrix.data = matrix.data[:2]
    else:
        matrix.coords = (np.array([0, 1, 9 if damage == "outside" else -9]), matrix.coords[1])
    (tmp_path / "m.pkl").write_bytes(pickle.dumps({"J_regressor": matrix}))
    with pytest.raises(UnpickleError, match=r"m\.pkl: "):
        read_arrays(tmp_path / "m.pkl")


@pytest.mark.parametrize("content", [{"a": torch.zeros(3)}, torch.zeros(3), [torch.zeros(2), 1]])
@pytest.mark.parametrize("ending", ["pt", "pth", "npz"])
def test_files_of_pytorch_are_called_so(content: Any, ending: str, tmp_path: Path) -> None:
    torch.save(content, tmp_path / f"flame.{ending}")
    with pytest.raises(HeadError, match=rf"flame\.{ending}: is a PyTorch file; give the \.pkl"):
        read_flame(tmp_path / f"flame.{ending}")


def _edit_line(text: str, key: str, change: Callable[[str], str]) -> str:
    lines = text.splitlines()
    at = next(index for index, line in enumerate(lines) if line.startswith(key))
    lines[at] = change(lines[at])
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("face", "says"),
    [
        ("f 1/1 2/2 5024/3", "vertex number 5024; there are 5,023"),
        ("f 1/1 2/2 3/900000", "texture coordinate number 900000"),
        ("f 1/1 2/2 -9000/3", "vertex number -"),
        ("f 0/1 2/2 99999/3", "vertex number"),
    ],
)
def test_corners_outside_the_mesh_are_named(face: str, says: str, tmp_path: Path) -> None:
    arrays = flame_arrays()
    np.savez(tmp_path / "model.npz", **arrays)
    mesh = write_obj(tmp_path / "mesh.obj", arrays)
    mesh.write_text(_edit_line(mesh.read_text(), "f ", lambda _: face))
    with pytest.raises(HeadError, match=rf"mesh\.obj: a triangle names {says}"):
        read_flame(tmp_path / "model.npz", mesh)


@pytest.mark.parametrize(
    ("start", "says"),
    [
        ("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 53023716\n", "a Git LFS pointer"),
        ("<!DOCTYPE html><html><body>Sign in</body></html>", "a web page"),
        ("\n<html lang='en'>", "a web page"),
        ('<?xml version="1.0"?><Error>AccessDenied</Error>', "a web page"),
    ],
)
def test_what_a_download_left_instead_is_named(start: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "model.pkl").write_text(start)
    with pytest.raises(HeadError, match=rf"model\.pkl: is {says}, not the model file"):
        read_flame(tmp_path / "model.pkl")
