"""Codes of the surface and the way back to the atlas."""

import pytest
import torch

from tests.heads import sphere_head
from uika.head import load_head, uv_texels
from uika.model.surface_codes import UvLookup, bound, codes_at, surface_table


def test_codes_lead_back_to_their_place_in_the_atlas() -> None:
    head = load_head().without_bust
    binding = uv_texels(head, 384)
    uv = binding.uv[:: len(binding) // 4000]
    found, away = UvLookup(surface_table(head, 128))(codes_at(head, uv))
    error = 384 * (found - uv).norm(dim=-1)
    assert float(error.median()) < 0.05
    assert float(error.quantile(0.99)) < 1.5  # beyond lie points where two parts of the surface touch
    assert float(away.median()) < 0.002


def test_codes_have_no_seams() -> None:
    """Places on both sides of a cut in the atlas, which are one place on the head, have one code."""
    head = sphere_head()
    corner_uv = head.uvs[head.uv_faces].flatten(0, 1) * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1.0])
    vertex = head.faces.flatten()
    inward = torch.lerp(corner_uv, corner_uv.view(-1, 3, 2).mean(1).repeat_interleave(3, 0), 0.02)
    code = codes_at(head, inward, 512)
    first = torch.zeros(len(head.template), 4).index_copy(0, vertex, code)
    assert float((corner_uv[:, None] - corner_uv[None]).norm(dim=-1)[vertex[:, None] == vertex[None]].max()) > 0.5
    assert float((code - first[vertex]).norm(dim=-1).max()) < 0.05  # 5 mm, of triangles of 25 mm


@pytest.mark.parametrize("size", [256, 1024])
def test_places_are_bound_to_the_triangle_that_holds_them(size: int) -> None:
    head = load_head().without_bust
    binding = uv_texels(head, 200)
    triangle, mix = bound(head, binding.uv, size)
    corners = head.uvs[head.uv_faces[triangle]] * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1.0])
    back = (corners * mix[..., None]).sum(1)
    assert float((back - binding.uv).norm(dim=-1).quantile(0.99)) < 1e-3
    assert torch.allclose(mix.sum(-1), torch.ones(len(mix)))
