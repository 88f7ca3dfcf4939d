import pytest
import torch

import uika.canonical.surface
from uika.head import load_head, uv_texels


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
