"""Ways to run what a file says must not exist in the packages, and the damage that readers must survive."""

from __future__ import annotations

import ast
import io
import json
import os
import pickle
import struct
import tarfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from uika.avatar import Avatar, AvatarError
from uika.data import DataError, open_capture, read_shard
from uika.head_import.unpickle import UnpickleError, read_arrays
from uika.io.npz import ArraysError, read_npz
from uika.motion import MotionError, read_json

from .fuzz import fuzz
from .targets import TARGETS, captures

ROOT = Path(__file__).resolve().parents[2]
COUNT = int(os.environ.get("UIKA_FUZZ", 60))
# The one unpickler: every name resolves to an inert record, see uika.head_import.unpickle.
ALLOWED = {("uika/head_import/unpickle.py", "pickle.Unpickler")}
LOADERS = {
    *("pickle.load", "pickle.loads", "pickle.Unpickler", "cPickle.load", "dill.load", "dill.loads", "joblib.load"),
    *("marshal.load", "marshal.loads", "shelve.open", "yaml.load", "yaml.unsafe_load", "jsonpickle.decode"),
    *("os.system", "os.popen", "subprocess.getoutput", "cloudpickle.load", "cloudpickle.loads"),
}


def _dangers(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and ast.unparse(node) in LOADERS:
            yield ast.unparse(node)
        if isinstance(node, ast.ImportFrom) and node.module in ("pickle", "marshal", "shelve", "dill", "joblib"):
            yield f"from {node.module} import"
        if not isinstance(node, ast.Call):
            continue
        name, given = ast.unparse(node.func), {k.arg: ast.unparse(k.value) for k in node.keywords}
        if name in ("eval", "exec", "compile", "__import__"):
            yield name
        if name in ("torch.load", "torch.hub.load") and given.get("weights_only") != "True":
            yield f"{name} without weights_only=True"
        if name in ("np.load", "numpy.load") and given.get("allow_pickle") != "False":
            yield f"{name} without allow_pickle=False"
        if given.get("shell") == "True":
            yield f"{name} with a shell"


def test_nothing_runs_what_a_file_says() -> None:
    found = set()
    for package in ("uika", "drjit_splat", "scenes"):
        for path in (ROOT / package).rglob("*.py"):
            place = path.relative_to(ROOT).as_posix()
            found |= {(place, danger) for danger in _dangers(ast.parse(path.read_text(encoding="utf-8")))}
    assert found == ALLOWED


def test_the_search_finds_what_it_looks_for() -> None:
    code = "eval('1'); torch.load('x'); np.load('x', allow_pickle=True); pickle.loads(b''); run('x', shell=True)"
    assert len(set(_dangers(ast.parse(code)))) == 5


QUICK = ("photo", "avatar", "shard")


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in TARGETS]
)
def test_damaged_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    result = fuzz(name, COUNT, 1, tmp_path)
    assert result.findings == {}
    assert result.read and result.refused
    assert result.grown < 1024


def _npz(header: bytes, packing: int = zipfile.ZIP_DEFLATED, body: bytes = b"") -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", packing) as archive:
        member = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + body
        archive.writestr("a.npy", member)
    return out.getvalue()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (_npz(b"{'descr': '<f4', 'fortran_order': False, 'shape': (4000000000,)}\n"), "more than the file holds"),
        (_npz(b"{'descr': '<U99999999', 'fortran_order': False, 'shape': (21,)}\n"), "more than the file holds"),
        (_npz(b"{'descr': '<f4', 'fortran_order': False, 'shape': (-1,)}\n"), "more than the file holds"),
        (_npz(b"{'descr': '|O', 'fortran_order': False, 'shape': (1,)}\n"), "only numbers and text"),
        (_npz(b"{'descr': '<f4', 'fortran_order': False, 'shape': (\n"), "."),
        (_npz(b"{'descr': '<f4'}\n", zipfile.ZIP_LZMA), "does not use"),
        (b"PK\x03\x04", "."),
    ],
)
def test_arrays_promise_no_more_than_they_hold(data: bytes, words: str) -> None:
    with pytest.raises(ArraysError, match=words):
        read_npz(data)


def test_an_archive_that_unpacks_to_gigabytes_is_refused_unread() -> None:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as member:
        for _ in range(600):
            member.write(bytes(1 << 20))
    assert len(out.getvalue()) < 1 << 20
    with pytest.raises(ArraysError, match="more than 512 MiB"):
        read_npz(out.getvalue())


def test_a_shard_entry_of_nothing_but_holes_is_refused(tmp_path: Path) -> None:
    info = tarfile.TarInfo("a.png")
    info.size = 1 << 50
    (tmp_path / "a.tar").write_bytes(info.tobuf(tarfile.GNU_FORMAT) + bytes(1024))
    with pytest.raises(DataError, match="promises more"):
        list(read_shard(tmp_path / "a.tar"))


def test_a_sparse_matrix_that_repeats_itself_is_refused(tmp_path: Path) -> None:
    from scipy import sparse

    matrix = sparse.csc_matrix(np.eye(3))
    matrix.indptr = np.array([0, 1, 2, 2**40])
    (tmp_path / "m.pkl").write_bytes(pickle.dumps({"J_regressor": matrix}))
    with pytest.raises(UnpickleError, match="do not fit together"):
        read_arrays(tmp_path / "m.pkl")


def test_one_array_under_many_names_is_refused(tmp_path: Path) -> None:
    array = np.zeros(1 << 20)
    (tmp_path / "m.pkl").write_bytes(pickle.dumps({f"a{index}": array for index in range(100)}))
    with pytest.raises(UnpickleError, match="more than 512 MiB"):
        read_arrays(tmp_path / "m.pkl")


@pytest.mark.parametrize(
    "change",
    [{"fl_x": 10**400}, {"file_path": "x" * 5000}, {"file_path": "a\0b"}, {"file_path": None}],
)
def test_camera_and_paths_of_a_capture(change: dict[str, object], tmp_path: Path) -> None:
    (description,) = captures(tmp_path)
    content = json.loads(description.read_text())
    content["frames"][0] |= change
    description.write_text(json.dumps(content))
    with pytest.raises(DataError, match="frame 0"):
        open_capture(tmp_path, strict=True)


def test_a_camera_without_an_inverse_is_refused(tmp_path: Path) -> None:
    (description,) = captures(tmp_path)
    content = json.loads(description.read_text())
    content["frames"][0]["transform_matrix"] = [[0.0] * 4] * 4
    description.write_text(json.dumps(content))
    with pytest.raises(DataError, match="cannot be inverted"):
        open_capture(tmp_path, strict=True).sample(0)


def test_a_number_that_no_float_holds_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"jawOpen": 1' + "0" * 400 + "}")
    with pytest.raises(MotionError, match=r"a\.json"):
        read_json(tmp_path / "a.json")


def test_provenance_nested_too_deep_is_refused(tmp_path: Path) -> None:
    (path,) = TARGETS["avatar"].seeds(tmp_path)
    data = path.read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + size])
    header["__metadata__"]["provenance"] = "[" * 100_000
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + data[8 + size :])
    with pytest.raises(AvatarError, match="header"):
        Avatar.load(path)
