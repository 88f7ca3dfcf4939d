"""What the photos say about the atlas before any network looks at it (paper section 3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from uika.canonical.surface import SurfaceTexels
from uika.model.config import UvConfig
from uika.uv import Sums, close_gaps, fill, mirror_preference, pool

GAP = 5  # texels between the rows of pixels that show a side at a grazing angle
SIDE = 0.5  # share of the face below which a texel lies beside it


class Observation(NamedTuple):
    """The pooled views, float32."""

    color: Tensor  # [B,3,S,S] aggregate, completed where the config asks for it
    confidence: Tensor  # [B,1,S,S]
    known: Tensor  # [B,1,S,S] in [0,1], how far `color` is what the photos show at that very place
    report: dict[str, int]


@torch.no_grad()
def observe(config: UvConfig, views: Sequence[Sums], texel: Tensor, surface: SurfaceTexels) -> Observation:
    """Pool and complete the sums [C,S,S] of all views of one head; the report: see `Reconstructor.forward`."""
    size = views[0].weight.shape[-1]
    valid = torch.zeros(size * size, dtype=torch.bool, device=texel.device)
    valid[texel] = True
    valid = valid.view(size, size)
    total = together(views)
    pooled = pool(total, normalization=config.normalization, close_radius=config.close_radius, valid=valid)
    empty = int(((pooled.hits <= 0) & valid).sum())
    color = pooled.rgb
    share = (pooled.trust / config.full_trust).clamp(0, 1)
    if config.fill:
        if surface.face is not None:
            # Lids and lips have gaps that are none of the photo's: what they hide must not be painted over.
            color, share = close_gaps(color, share, valid & (surface.face[0] < SIDE), GAP)
        if surface.mirror is not None:
            share = share * mirror_preference(pooled.trust, valid, surface.mirror)
        color = fill(color, share, valid, surface.mirror, regions=surface.regions, prior=surface.prior)
    report = {
        "views": len(views),
        "empty_views": sum(not bool(view.weight.any()) for view in views),
        "texels": len(texel),
        "empty_texels": empty,
        "completed_texels": empty if config.fill else 0,
    }
    return Observation(color, pooled.confidence, share * valid, report)


def together(views: Sequence[Sums]) -> Sums:
    """Sums of single views -> those of all of them as one, [1,1,C,S,S]."""
    total = Sums(*(part.clone() for part in views[0]))
    for view in views[1:]:
        for part, more in zip(total, view, strict=True):
            part += more
    return Sums(*(part[None, None] for part in total))
