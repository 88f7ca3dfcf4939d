"""The built-in head with its bust: an unchanged head, a torso that stands still, a second tile of the atlas."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch

from uika.assets import HEAD
from uika.head import HeadError, HeadParameters, load_head, pose_vertices, save_arrays, save_head, uv_texels
from uika.head.bust import BustArrays, pack_bust, unpack_bust


def test_the_head_begins_the_bust_unchanged() -> None:
    whole, alone = load_head(), load_head(HEAD)
    assert (whole.id, alone.id, whole.without_bust.id) == ("builtin-2", "builtin-1", "builtin-1")
    for field in fields(alone):
        mine, other = getattr(alone, field.name), getattr(whole.without_bust, field.name)
        if isinstance(mine, torch.Tensor):
            assert torch.equal(mine, other), field.name
    assert all(torch.equal(mask, whole.without_bust.masks[name]) for name, mask in alone.masks.items())
    assert whole.without_bust is whole.without_bust
    assert alone.without_bust is alone
    ours, theirs = uv_texels(whole, 96), uv_texels(alone, 96)
    assert torch.equal(ours.texel, theirs.texel) and torch.equal(ours.barycentric, theirs.barycentric)


def test_the_mesh_is_closed_but_for_the_cut() -> None:
    head = load_head()
    bust = head.bust
    assert bust is not None
    corners = head.faces[bust.face :]
    edges = torch.cat((corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]])).sort(1).values
    unique, count = edges.unique(dim=0, return_counts=True)
    assert int(count.max()) == 2
    border = unique[count == 1]
    rim = border[(border < bust.vertex).all(1)]
    assert len(rim) == 42  # the head's lower rim
    low = head.template[border[(border >= bust.vertex).any(1)].unique(), 1]
    assert float(low.max() - low.min()) < 1e-5
    assert not bool(((border < bust.vertex).sum(1) == 1).any())


def test_the_torso_stands_still_when_the_neck_turns() -> None:
    head = load_head()
    assert head.bust is not None
    params = HeadParameters.zeros(head).replace(neck=torch.tensor([0.2, 0.5, 0.1]))
    moved = (pose_vertices(head, params) - head.template).norm(dim=-1)
    torso = head.lbs_weights[head.bust.vertex :, 0]
    assert float((torso > 0.999).float().mean()) > 0.6
    assert float(moved[head.bust.vertex :][torso > 0.999].max()) < 1e-4
    assert float(moved[: head.bust.vertex].max()) > 0.05


def test_the_bust_fills_its_own_tile() -> None:
    head = load_head()
    assert head.bust is not None
    binding = uv_texels(head, 128, tile=1)
    assert len(binding) > 4000
    assert int(binding.triangle.min()) >= head.bust.face
    uv = (head.uvs[head.uv_faces[binding.triangle]] * binding.barycentric[..., None]).sum(1)
    expected = torch.stack((uv[:, 0] - 1, 1 - uv[:, 1]), 1)
    torch.testing.assert_close(binding.uv, expected, atol=1e-5, rtol=0)


def test_a_head_with_bust_survives_its_file(tmp_path: Path) -> None:
    head = load_head()
    save_head(head, tmp_path / "whole.npz")
    read = load_head(tmp_path / "whole.npz")
    assert read.bust is not None and head.bust is not None
    assert (read.bust.vertex, read.bust.face, read.bust.uv) == (head.bust.vertex, head.bust.face, head.bust.uv)
    torch.testing.assert_close(read.bust.modes, head.bust.modes, atol=1e-6, rtol=0)
    assert read.without_bust.id == "builtin-1"
    assert read.to(torch.float64).bust.modes.dtype == torch.float64


def test_packed_shapes_come_back() -> None:
    generator = torch.Generator().manual_seed(0)
    mix, shapes = torch.randn(6, 2, generator=generator), torch.randn(2, 5, 3, generator=generator)
    given = BustArrays(
        "x",
        torch.randn(5, 3, generator=generator),
        torch.tensor([[0, 1, 2]]),
        torch.rand(3, 2, generator=generator),
        torch.tensor([[0, 1, 2]]),
        torch.eye(5),
        torch.einsum("kr,rvc->kvc", mix, shapes),
        torch.randn(3, 5, 3, generator=generator),
    )
    back = unpack_bust(pack_bust(given, 2))
    torch.testing.assert_close(back.identity, given.identity, atol=1e-3, rtol=0)
    torch.testing.assert_close(back.modes, given.modes, atol=1e-3, rtol=0)
    torch.testing.assert_close(back.template, given.template)


def test_a_bust_of_another_head_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import uika.head.files as files

    with np.load(files.BUST) as file:
        arrays = {name: file[name] for name in file.files if name != "sha256"}
    save_arrays(arrays | {"head_id": np.array("other")}, tmp_path / "bust.npz")
    monkeypatch.setattr(files, "BUST", tmp_path / "bust.npz")
    files._builtin.cache_clear()
    try:
        with pytest.raises(HeadError, match="made for the head model 'other', not for 'builtin-1'"):
            load_head()
    finally:
        files._builtin.cache_clear()
