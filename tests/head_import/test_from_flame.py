"""A bare head gets landmarks and masks from its geometry."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.flame_files import flame_arrays, write_obj, write_pickle
from uika.cli import main
from uika.fitting import fit_landmarks
from uika.head import HeadModel, load_head, look_at, project
from uika.head.actions import fitted_joints
from uika.head.face_paint import mouth_slit
from uika.head_import import adopt
from uika.head_import.landmark_embedding import nearest


@pytest.fixture(scope="module")
def builtin() -> HeadModel:
    return load_head()


def test_mouth_lies_between_the_lips(builtin: HeadModel) -> None:
    marks = dict(zip(builtin.landmark_ids.tolist(), builtin.landmarks(builtin.template), strict=True))
    middle = (marks[13] + marks[14]) / 2
    assert float((mouth_slit(builtin) - middle).norm()) < 0.008


def test_nearest_point_on_a_mesh(builtin: HeadModel) -> None:
    generator = torch.Generator().manual_seed(0)
    face = torch.randint(len(builtin.faces), (20,), generator=generator)
    mix = torch.distributions.Dirichlet(torch.ones(3)).sample((20,))
    points = (builtin.template[builtin.faces[face]] * mix[..., None]).sum(1)
    triangle, found, distance = nearest(points, builtin.template, builtin.faces)
    place = (builtin.template[builtin.faces[triangle]] * found[..., None]).sum(1)
    torch.testing.assert_close(place, points, atol=1e-6, rtol=0)
    assert float(distance.max()) < 1e-6
    far = nearest(torch.tensor([[0.0, 0.0, 1.0]]), builtin.template, builtin.faces)[2]
    assert float(far) == pytest.approx(1 - float(builtin.template[:, 2].max()), abs=0.03)


@pytest.mark.slow
def test_embedding_and_masks_of_the_built_in_head_are_found_again(builtin: HeadModel) -> None:
    builtin = builtin.without_bust  # what is imported has none; a neck's mask would take the shoulders in
    bare = replace(builtin, masks={}, landmark_ids=builtin.landmark_ids[:0], landmark_faces=builtin.landmark_faces[:0],
                   landmark_barycentrics=builtin.landmark_barycentrics[:0],
                   landmark_weights=builtin.landmark_weights[:0])  # fmt: skip
    found = adopt(bare)
    one, other = (dict(zip(h.landmark_ids.tolist(), h.landmarks(h.template), strict=True)) for h in (found, builtin))
    shared = sorted(set(one) & set(other))
    assert len(shared) > 470
    assert float(torch.stack([(one[i] - other[i]).norm() for i in shared]).median()) < 2e-3
    for name in ("face", "lips", "ears", "scalp", "neck", "eyeballs"):
        a, b = found.masks[name] > 0.5, builtin.masks[name] > 0.5
        overlap = float((a & b).sum() / (a | b).sum())
        assert overlap > {"lips": 0.35, "ears": 0.5, "neck": 0.5}.get(name, 0.6), (name, overlap)


@pytest.mark.slow
def test_import_command_makes_a_head_that_fits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arrays = flame_arrays()
    model, mesh = write_pickle(tmp_path / "flame2023.pkl", arrays), write_obj(tmp_path / "flame.obj", arrays)
    output = tmp_path / "flame.npz"
    assert main(["head", "import", str(model), "--obj", str(mesh), "-o", str(output)]) == 0
    said = capsys.readouterr()
    assert "6,124 vertices" in said.out  # 5,023 of FLAME and the bust
    assert [line.split()[0] for line in said.err.splitlines()] == ["reading", "finding", "marking", "adding", "writing"]
    head = load_head(output)
    assert fitted_joints(head) == (2, 3, 4)
    marks = torch.full((1, 478, 2), 256.0)
    camera = look_at(15.0, 5.0, 1.1, fov_y=20.0, size=512)
    marks[0, head.landmark_ids] = project(head.landmarks(head.template), camera)[0]
    assert float(fit_landmarks(marks, head, 512).error) < 0.01
    assert main(["head", "import", str(tmp_path / "none.pkl")]) == 2
    np.savez(tmp_path / "poor.npz", v_template=np.zeros((10, 3)))
    assert main(["head", "import", str(tmp_path / "poor.npz")]) == 2
    assert "v_template" in capsys.readouterr().err
