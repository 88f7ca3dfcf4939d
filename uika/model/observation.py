"""What the photos say about the atlas before any network looks at it (paper section 3.1)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from uika.model.config import UvConfig
from uika.model.gaussians import SurfaceTexels
from uika.uv import Sums, fill, pool


class Observation(NamedTuple):
    """The pooled views, float32."""

    color: Tensor  # [B,3,S,S] aggregate, completed where the config asks for it
    confidence: Tensor  # [B,1,S,S]
    report: dict[str, int]


@torch.no_grad()
def observe(config: UvConfig, sums: Sums, texel: Tensor, surface: SurfaceTexels) -> Observation:
    """Pool and complete the sums [B,V,...] of all views; the report is described at `Reconstructor.forward`."""
    batch, views, _, size, _ = sums.weight.shape
    valid = torch.zeros(size * size, dtype=torch.bool, device=texel.device)
    valid[texel] = True
    valid = valid.view(size, size)
    pooled = pool(sums, normalization=config.normalization, close_radius=config.close_radius, valid=valid)
    empty = int(((pooled.hits <= 0) & valid).sum())
    color = pooled.rgb
    if config.fill:
        share = (pooled.trust / config.full_trust).clamp(0, 1)
        color = fill(color, share, valid, surface.mirror, regions=surface.regions, prior=surface.prior)
    report = {
        "views": batch * views,
        "empty_views": int((sums.weight.amax(dim=(2, 3, 4)) <= 0).sum()),
        "texels": batch * len(texel),
        "empty_texels": empty,
        "completed_texels": empty if config.fill else 0,
    }
    return Observation(color, pooled.confidence, report)


def join(views: list[Sums]) -> Sums:
    """Sums [C,S,S] of single views -> [1,V,C,S,S]."""
    return Sums(*(torch.stack(parts)[None] for parts in zip(*views, strict=True)))
