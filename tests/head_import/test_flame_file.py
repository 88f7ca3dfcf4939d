"""FLAME files are read without running anything in them."""

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.flame_files import flame_arrays, write_obj, write_pickle
from uika.head import HeadError, HeadParameters, load_head, pose_vertices, save_head, uv_texels
from uika.head_import.flame_file import read_flame
from uika.head_import.unpickle import UnpickleError, read_arrays


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("flame")
    arrays = flame_arrays()
    write_pickle(place / "model.pkl", arrays)
    write_obj(place / "mesh.obj", arrays)
    np.savez(place / "model.npz", **arrays)
    return place


class Attack:
    def __init__(self, call: object, *arguments: object) -> None:
        self.call, self.arguments = call, arguments

    def __reduce__(self) -> tuple:
        return self.call, self.arguments


def test_pickle_and_npz_give_the_same_head(folder: Path) -> None:
    one = read_flame(folder / "model.pkl", folder / "mesh.obj")
    other = read_flame(folder / "model.npz")
    assert (len(one.template), len(one.identity_basis), len(one.expression_names)) == (5023, 300, 100)
    for name in ("template", "identity_basis", "expression_basis", "pose_basis", "joints", "lbs_weights", "faces"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name
    torch.testing.assert_close(one.uvs, other.uvs, atol=1e-6, rtol=0)


def test_values_survive_the_pickle(folder: Path) -> None:
    arrays, found = flame_arrays(), read_arrays(folder / "model.pkl")
    for name in ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "f"):
        np.testing.assert_array_equal(found[name], arrays[name], err_msg=name)
    assert "bs_style" not in found


def test_head_is_posed_by_its_joints_and_correctives(folder: Path) -> None:
    head = read_flame(folder / "model.npz")
    builtin = load_head()
    torch.testing.assert_close(head.joints, builtin.joints, atol=1e-5, rtol=0)
    params = HeadParameters.zeros(head).replace(jaw=torch.tensor([0.3, 0.0, 0.0]))
    moved = (pose_vertices(head, params) - head.template).norm(dim=-1)
    assert 0.01 < float(moved[head.lbs_weights[:, 2] > 0.9].mean()) < 0.05
    correctives = torch.einsum("k,kvc->vc", torch.ones(36), head.pose_basis)
    np.testing.assert_allclose(correctives, flame_arrays()["posedirs"].sum(-1), atol=1e-6)
    assert len(uv_texels(head, 64)) > 1000


def test_head_file_round_trip(folder: Path, tmp_path: Path) -> None:
    head = read_flame(folder / "model.npz")
    save_head(head, tmp_path / "flame.npz")
    again = load_head(tmp_path / "flame.npz")
    assert again.id == head.id
    torch.testing.assert_close(again.identity_basis, head.identity_basis, atol=1e-6, rtol=0)


def test_eyelids_become_expressions(folder: Path, tmp_path: Path) -> None:
    lid = np.zeros((5023, 3), dtype=np.float32)
    lid[7] = 0.01
    for side in ("l", "r"):
        np.save(tmp_path / f"{side}.npy", lid)
    head = read_flame(folder / "model.npz", eyelids=(tmp_path / "l.npy", tmp_path / "r.npy"))
    assert head.expression_names[-2:] == ("eyelidLeft", "eyelidRight")
    assert float(head.expression_basis[-1, 7].norm()) > 0.01
    np.save(tmp_path / "l.npy", lid[:10])
    with pytest.raises(HeadError, match=r"l\.npy.*eyelids need"):
        read_flame(folder / "model.npz", eyelids=(tmp_path / "l.npy", tmp_path / "r.npy"))


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
@pytest.mark.parametrize(
    ("call", "named"), [(os.system, "system"), (eval, "eval"), (getattr, "getattr"), (np.load, "load")]
)
def test_code_in_a_pickle_is_refused_and_not_run(tmp_path: Path, protocol: int, call: object, named: str) -> None:
    mark = tmp_path / "ran"
    content = {"v_template": np.zeros((5023, 3)), "f": Attack(call, f"touch {mark}")}
    path = tmp_path / "bad.pkl"
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    with pytest.raises(UnpickleError, match=rf"bad\.pkl: refers to '[\w.]*\.{named}'"):
        read_arrays(path)
    with pytest.raises(HeadError, match=named):
        read_flame(path)
    assert not mark.exists()


@pytest.mark.parametrize("protocol", [1, 2, 4])
@pytest.mark.parametrize("depth", ["list", "key", "array state", "chumpy"])
def test_code_below_the_surface_is_refused_and_not_run(tmp_path: Path, protocol: int, depth: str) -> None:
    mark = tmp_path / "ran"
    attack = Attack(os.system, f"touch {mark}")
    hidden = {
        "list": [[{"a": (1, [attack])}]],
        "key": {Attack(os.system, f"touch {mark}"): 1},
        "array state": Attack(np.array, attack),
        "chumpy": {"x": {"dterms": attack}},
    }[depth]
    path = tmp_path / "nested.pkl"
    path.write_bytes(pickle.dumps({"v_template": np.zeros((5023, 3)), "notes": hidden}, protocol=protocol))
    with pytest.raises(UnpickleError, match=r"nested\.pkl: refers to '[\w.]*(system|array)'"):
        read_arrays(path)
    assert not mark.exists()


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"\x80\x02\x83\x01\x00.", "EXT2"),
        (b"\x80\x02\x84\x01\x00\x00\x00.", "EXT4"),
        (b"\x80\x02csubprocess\nPopen\n(X\x04\x00\x00\x00echot\x81.", "Popen"),
        (b"\x80\x04\x8c\x02os\x8c\x06system\x93)}\x92.", "os.system"),
        (b"\x80\x04\x8c\x05numpy\x8c\x0endarray.tofile\x93.", "ndarray.tofile"),
        (b"\x80\x02cnumpy.core.multiarray\n_reconstruct\nK\x01\x85R.", "unknown class"),
        (b"\x80\x02Vid\nQ.", "BINPERSID"),
        (b"Pid\n.", "PERSID"),
        (b"\x80\x02\x82\x01.", "EXT1"),
        (b"(S'echo'\nios\nsystem\n.", "INST"),
        (b"(cos\nsystem\nS'echo'\no.", "system"),
        (b"\x80\x02cnumpy\nndarray\nr\xff\xff\xff\x7f.", "memo"),
        (b"\x80\x02]q\x00.", "holds a list"),
        (b"\x80\x02c_codecs\nencode\n}X\x01\x00\x00\x00aK\x01sb.", "change a function"),
        (b"\x80\x02}q\x00(U\x01acnumpy\ndtype\nU\x02O8K\x00K\x01\x87R", "damaged"),
        (b"", "damaged"),
        (b"not a pickle at all", "damaged"),
    ],
)
def test_odd_pickles_are_refused(tmp_path: Path, data: bytes, says: str) -> None:
    path = tmp_path / "odd.pkl"
    path.write_bytes(data)
    with pytest.raises(UnpickleError, match=rf"odd\.pkl: .*{says}"):
        read_arrays(path)


def test_arrays_of_objects_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "objects.pkl"
    path.write_bytes(pickle.dumps({"a": np.array([{}], dtype=object)}, protocol=2))
    with pytest.raises(UnpickleError, match="only numbers"):
        read_arrays(path)


def test_python_2_pickles_are_read(tmp_path: Path) -> None:
    values = np.array([1.5, -2.0], dtype="<f8")
    data = (
        b"\x80\x02}U\x01acnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tU\x01btR(K\x01(K\x02t"
        b"cnumpy\ndtype\n(U\x02f8K\x00K\x01tR(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89U\x10"
        + values.tobytes()
        + b"tbs."
    )
    path = tmp_path / "old.pkl"
    path.write_bytes(data)
    np.testing.assert_array_equal(read_arrays(path)["a"], values)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"v_template": np.zeros((5000, 3))}, r"'v_template' has shape \(5000, 3\) where FLAME has \(5023, 3\)"),
        ({"posedirs": None}, "lacks the array 'posedirs'"),
        ({"weights": np.full((5023, 5), np.nan)}, "'weights' does not hold finite numbers"),
        ({"kintree_table": np.array([[-1, 0, 0, 1, 1]])}, "kintree_table"),
        ({"vt": None}, "no texture coordinates"),
        ({"f": np.full((4, 3), 6000), "ft": np.zeros((4, 3))}, r"'faces' points outside 0\.\.5022"),
    ],
)
def test_files_that_do_not_fit_are_named(tmp_path: Path, change: dict, says: str) -> None:
    arrays = {name: array for name, array in {**flame_arrays(), **change}.items() if array is not None}
    path = tmp_path / "model.npz"
    np.savez(path, **arrays)
    with pytest.raises(HeadError, match=says):
        read_flame(path)


def test_damaged_files_are_named(folder: Path, tmp_path: Path) -> None:
    for name in ("model.npz", "model.pkl"):
        cut = tmp_path / name
        cut.write_bytes((folder / name).read_bytes()[:5000])
        with pytest.raises(HeadError, match=rf"{name}.*damaged"):
            read_flame(cut)
    with pytest.raises(HeadError, match="no such model file"):
        read_flame(tmp_path / "none.pkl")
    short = tmp_path / "short.obj"
    short.write_text("v 0 0 0\nvt 0 0\nf 1/1 1/1 1/1\n")
    with pytest.raises(HeadError, match=r"short\.obj: has 1 vertices"):
        read_flame(folder / "model.pkl", short)
    short.write_text("v 0 0\nf 1 1 1\n")
    with pytest.raises(HeadError, match=r"short\.obj: a line is damaged"):
        read_flame(folder / "model.pkl", short)
