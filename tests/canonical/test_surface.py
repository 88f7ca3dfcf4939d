import pytest
import torch

import uika.canonical.surface
from drjit_splat import rasterization
from uika.head import load_head, look_at, project, rasterize, surface_points, uv_texels


def test_splats_along_the_seams_of_the_atlas_are_larger(monkeypatch: pytest.MonkeyPatch) -> None:
    head, size = load_head(), 96
    none = torch.zeros(len(head.identity_basis)), torch.zeros_like(head.template)
    larger = uika.canonical.surface.surface_texels(head, *none, size)[0].scales[0]
    monkeypatch.setattr(uika.canonical.surface, "SEAM", 1.0)
    plain = uika.canonical.surface.surface_texels(head, *none, size)[0].scales[0]
    row, column = uv_texels(head, size).texel // size, uv_texels(head, size).texel % size
    taken = set(zip(row.tolist(), column.tolist(), strict=True))
    around = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1)]
    inside = [all((r + d, c + e) in taken for d, e in around) for r, c in sorted(taken)]
    border = [r in (0, size - 1) or c in (0, size - 1) for r, c in sorted(taken)]
    expected = torch.where(torch.tensor(inside), 1.0, 1.4)
    known = ~torch.tensor(border)  # beyond the picture's border lies nothing to count
    ratio = (larger / plain)[known]
    assert 0.05 < (~torch.tensor(inside)).float().mean() < 0.5
    torch.testing.assert_close(ratio, expected[known, None].expand_as(ratio))


def _stripes_psnr(yaw: float) -> float:
    """How well splats painted with stripes agree with the striped mesh."""
    head, size = load_head(), 512
    none = torch.zeros(len(head.identity_basis)), torch.zeros_like(head.template)
    surface, binding = uika.canonical.surface.surface_texels(head, *none, 384)
    camera = look_at(yaw, 0.0, 1.2, fov_y=14.0, size=size)

    def stripes(points: torch.Tensor) -> torch.Tensor:
        return (0.5 + 0.4 * torch.sin(points[..., [0, 1, 2]] * 800.0)).float()

    colors = stripes(surface_points(head.template, head.faces, binding))
    shown, alpha, _ = rasterization(
        surface.points[0], surface.quats[0], surface.scales[0], torch.full((len(binding),), 0.95), colors,
        camera.viewmat[None], camera.K[None], size, size,
    )  # fmt: skip
    pixels, depth = project(head.template, camera)
    triangle, mix = rasterize(pixels, head.faces, size, size, depth=depth)
    points = (head.template[head.faces[triangle.clamp_min(0)]] * mix[..., None]).sum(-2)
    scalp = (head.masks["scalp"][head.faces[triangle.clamp_min(0)]] * mix).sum(-1) > 0.9
    there = (triangle >= 0) & (alpha[0, ..., 0] > 0.95) & scalp
    return float(-10 * (shown[0][there] - stripes(points)[there]).square().mean().log10())


def test_colours_appear_where_the_surface_has_them(monkeypatch: pytest.MonkeyPatch) -> None:
    sunk = [_stripes_psnr(yaw) for yaw in (0.0, 70.0)]
    monkeypatch.setattr(uika.canonical.surface, "SINK", 0.0)
    plain = [_stripes_psnr(yaw) for yaw in (0.0, 70.0)]
    print(sunk, plain)
    assert all(one > other + 0.5 for one, other in zip(sunk, plain, strict=True))
