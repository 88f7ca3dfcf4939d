"""Which half of a face to believe: pixels that graze the far half of a turned face smear over many texels."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

_BLUR = 9  # texels over which it is judged how well a place was seen
_POWER = 3.0
_BARELY, _FAIRLY = 0.1, 0.4  # trust between which what was seen is kept, however well the other half was
_FRONTAL, _TURNED = 0.12, 0.35  # unevenness of the halves between which the preference comes in


@torch.no_grad()
def mirror_preference(trust: Tensor, valid: Tensor, mirror: Tensor) -> Tensor:
    """How much of an observation to keep where the other half of the face was seen much better.

    Args:
        trust: [B,1,S,S] mean weight of what was seen, 0 where nothing was.
        valid: [S,S] True on the head.
        mirror: [S,S] row-major index of each texel's counterpart, -1 where there is none.

    Returns:
        [B,1,S,S] factors in [0,1]; 1 everywhere when both halves were seen alike, as from the front or from both sides.
    """
    usable = (mirror >= 0) & valid
    near = functional.avg_pool2d(valid.to(trust.dtype)[None, None], _BLUR, 1, _BLUR // 2)
    own = functional.avg_pool2d(trust * valid, _BLUR, 1, _BLUR // 2) / near.clamp_min(1e-6)
    other = own.flatten(2)[:, :, mirror.clamp_min(0).flatten()].reshape(own.shape)
    kept = (2 * own**_POWER / (own**_POWER + other**_POWER).clamp_min(1e-9)).clamp(max=1)
    kept = torch.maximum(kept, ((own - _BARELY) / (_FAIRLY - _BARELY)).clamp(0, 1))
    uneven, total = ((value * usable).sum((1, 2, 3)) for value in ((own - other).abs(), own + other))
    gate = ((uneven / total.clamp_min(1e-9) - _FRONTAL) / (_TURNED - _FRONTAL)).clamp(0, 1)
    return torch.where(usable, 1 - gate[:, None, None, None] * (1 - kept), torch.ones_like(kept))
