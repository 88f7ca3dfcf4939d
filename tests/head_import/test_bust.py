"""A head in FLAME's format continued by the built-in head's bust."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.flame_files import flame_arrays
from uika.head import HeadError, HeadModel, HeadParameters, load_head, pose_vertices, save_head, uv_texels
from uika.head_import.bust import with_bust
from uika.head_import.flame_file import read_flame
from uika.head_import.landmark_embedding import nearest


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> HeadModel:
    """A FLAME head larger and elsewhere than the built-in one, its landmarks taken from that."""
    path = tmp_path_factory.mktemp("flame") / "flame.npz"
    np.savez(path, **flame_arrays())  # type: ignore[arg-type]
    head, builtin = read_flame(path), load_head().without_bust
    triangle, mix, _ = nearest(builtin.landmarks(builtin.template), head.template, head.faces)
    marked = replace(
        head,
        landmark_faces=triangle,
        landmark_barycentrics=mix,
        landmark_ids=builtin.landmark_ids,
        landmark_weights=builtin.landmark_weights,
        masks={"face": torch.zeros(len(head.template))},
    )
    return replace(marked, template=1.05 * head.template + torch.tensor([0.01, 0.02, -0.03]))


@pytest.fixture(scope="module")
def head(alone: HeadModel) -> HeadModel:
    return with_bust(alone)


def test_the_head_stays_as_it_is(alone: HeadModel, head: HeadModel) -> None:
    assert head.bust is not None and head.bust.vertex == 5023
    assert head.without_bust.id == alone.id != head.id
    for name in ("template", "identity_basis", "pose_basis", "faces", "uvs", "lbs_weights"):
        assert torch.equal(getattr(head.without_bust, name), getattr(alone, name)), name


def test_the_rim_is_closed(alone: HeadModel, head: HeadModel) -> None:
    corners = head.faces
    edges = torch.cat((corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]])).sort(1).values
    unique, count = edges.unique(dim=0, return_counts=True)
    border = unique[count == 1]
    assert int(count.max()) == 2
    low = head.template[border[(border >= len(alone.template)).all(1)].unique(), 1]
    assert float(low.max() - low.min()) < 2e-4  # the cut below the chest
    assert not bool(((border < len(alone.template)).sum(1) == 1).any())
    normals = torch.linalg.cross(*(head.template[corners[:, k]] - head.template[corners[:, 0]] for k in (1, 2)))
    middle = head.template[corners].mean(1)
    strip = (corners >= len(alone.template)).any(1) & (corners < len(alone.template)).any(1)
    away = middle[strip] - middle[strip].mean(0)
    assert int(strip.sum()) > 60
    assert float(((normals[strip] * away).sum(-1) > 0).float().mean()) > 0.97


def test_the_second_tile_is_filled_without_folds(head: HeadModel) -> None:
    assert head.bust is not None
    a, b, c = head.uvs[head.uv_faces[head.bust.face :]].unbind(1)
    one, other = b - a, c - a
    assert float((one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]).min()) > -1e-9
    assert len(uv_texels(head, 128, tile=1)) > 4000


def test_neck_and_shape_die_away_on_the_bust(head: HeadModel) -> None:
    assert head.bust is not None
    still = HeadParameters.zeros(head)
    moved = (pose_vertices(head, still.replace(neck=torch.tensor([0.2, 0.5, 0.1]))) - head.template).norm(dim=-1)
    below = head.template[:, 1].min() + 0.12 > head.template[:, 1]
    assert float(moved[below].max()) < 2e-3
    assert float(moved.max()) > 0.05
    edges = head.faces[head.bust.face :]
    crossing = edges[(edges < head.bust.vertex).any(1) & (edges >= head.bust.vertex).any(1)]
    posed = pose_vertices(head, still.replace(neck=torch.tensor([0.2, 0.5, 0.1])))
    longest = (posed[crossing[:, 0]] - posed[crossing[:, 2]]).norm(dim=-1).max()
    assert float(longest) < 0.04  # no tear at the rim
    wide = head.identity_basis[0].norm(dim=-1)
    assert float(wide[below & (torch.arange(len(wide)) >= head.bust.vertex)].max()) < 0.3 * float(wide.max())


def test_the_file_keeps_the_bust(head: HeadModel, tmp_path: Path) -> None:
    save_head(head, tmp_path / "head.npz")
    read = load_head(tmp_path / "head.npz")
    assert read.bust is not None and read.bust.vertex == 5023 and "torso" in read.masks


def test_necks_that_do_not_fit_are_refused(alone: HeadModel) -> None:
    low = alone.template[:, 1] < alone.template[:, 1].min() + 0.06
    far = alone.template + low[:, None] * torch.tensor([0.0, -0.5, 0.0])
    with pytest.raises(HeadError, match=r"its neck ends 0\.\d+ m off the built-in bust's; import it without bust"):
        with_bust(replace(alone, template=far))
    with pytest.raises(HeadError, match="shares 3 landmarks with the built-in head; 12 are needed"):
        few = {
            name: getattr(alone, name)[:3]
            for name in ("landmark_faces", "landmark_barycentrics", "landmark_ids", "landmark_weights")
        }
        with_bust(replace(alone, **few))
