"""The true colours of a head's atlas, out of pictures with exact correspondences."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from uika.data.views import SOLID, View
from uika.uv import accumulate, pool


def true_texture(views: Sequence[View], size: int) -> Tensor:
    """Mean colour of the pixels that show each texel, and where there is any: [4,size,size], red, green, blue, 0 or 1.

    Pixels at the person's edge, which are mixed with the backdrop, do not count. Empty if no view has labels.
    """
    labelled = [view for view in views if view.uv is not None]
    if not labelled:
        return torch.zeros(0)
    images = torch.stack([view.image for view in labelled])[None]
    uv = torch.stack([view.uv for view in labelled if view.uv is not None])[None]
    solid = torch.stack([(view.mask >= SOLID).float() for view in labelled])[None, :, None]
    pooled = pool(accumulate(images, uv, solid, size))
    return torch.cat((pooled.rgb[0], (pooled.hits[0] > 0).float()))
