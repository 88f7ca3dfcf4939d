"""How well images of one person agree with each other: warping errors with exact correspondences."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from uika.data.sample import Sample

_CELL = 512  # texels along the atlas in which two images meet
_MIN_SHARED = 100  # texels that both images must show


@dataclass(frozen=True)
class WarpingErrors:
    """Mean square difference of colours in [0,1] at the same place of the skin."""

    spatial: float  # between neighbouring views of one time step
    temporal: float  # between successive time steps of one view
    spatial_pairs: int
    temporal_pairs: int


def warping_errors(samples: Iterable[Sample], max_angle: float = 45.0) -> WarpingErrors:
    """Compare images through their correspondences to the atlas, which take the place of estimated optical flow.

    Two images are brought to the atlas, where the mean colour of each texel that both show is compared; what only one
    shows is hidden and does not count. The paper's dataset table gives such errors without its protocol in full.

    Args:
        samples: labelled images of one person.
        max_angle: degrees between the directions of two views that still count as neighbours.

    Raises:
        ValueError: a sample has no correspondences.
    """
    steps: dict[int, dict[str, tuple[Tensor, Tensor, Tensor]]] = defaultdict(dict)
    for sample in samples:
        steps[sample.timestep][sample.camera_id] = (*_to_atlas(sample), _direction(sample))
    spatial, temporal = [], []
    limit = float(np.cos(np.radians(max_angle)))
    for step, views in steps.items():
        names = sorted(views)
        for place, first in enumerate(names):
            for second in names[place + 1 :]:
                if float(views[first][2] @ views[second][2]) >= limit:
                    spatial.append(_difference(views[first], views[second]))
            if first in steps.get(step + 1, {}):
                temporal.append(_difference(views[first], steps[step + 1][first]))
    return WarpingErrors(*_means(spatial, temporal))


def _means(spatial: Sequence[float | None], temporal: Sequence[float | None]) -> tuple[float, float, int, int]:
    kept = [[value for value in values if value is not None] for values in (spatial, temporal)]
    means = [float(np.mean(values)) if values else float("nan") for values in kept]
    return means[0], means[1], len(kept[0]), len(kept[1])


def _to_atlas(sample: Sample) -> tuple[Tensor, Tensor]:
    """Texels [M] that an image shows, ascending, and their mean colours [M,3]."""
    if sample.uv is None or sample.uv_valid is None:
        raise ValueError(f"{sample.key} has no correspondences; warping errors need them")
    inside = sample.uv_valid & (sample.mask > 0.99)
    cell = (sample.uv[inside] * _CELL).long().clamp(0, _CELL - 1)
    texel, index, count = torch.unique(cell[:, 1] * _CELL + cell[:, 0], return_inverse=True, return_counts=True)
    colour = torch.zeros(len(texel), 3).index_add_(0, index, sample.image[:, inside].T)
    return texel, colour / count[:, None]


def _direction(sample: Sample) -> Tensor:
    return torch.nn.functional.normalize(sample.camera.position, dim=0)


def _difference(first: tuple[Tensor, Tensor, Tensor], second: tuple[Tensor, Tensor, Tensor]) -> float | None:
    shared = torch.isin(first[0], second[0])
    other = torch.isin(second[0], first[0])
    if int(shared.sum()) < _MIN_SHARED:
        return None
    return float(((first[1][shared] - second[1][other]) ** 2).mean())
