"""Landmarks where a correspondence estimator sees them: the pixels that show the points of the head they mark."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uika.head import HeadModel
from uika.model.estimator_file import check_estimator_head, read_estimator
from uika.photo.crop import resample, to_photo
from uika.photo.networks import person_mask
from uika.photo.preparation import CROP_TO_HEAD, HEAD_TO_FACE

if TYPE_CHECKING:
    from uika.photo.crop import Square

SIDE = 512  # pixels of the crop that the estimator sees
_NEAR = 0.02  # of the atlas: pixels farther from a landmark's place than this do not show it
_PIXELS = 12  # nearest ones whose mean is the landmark
_TRUST = 2.0  # a landmark moves at most so many widths of the mean move of all


class EstimatedLandmarks:
    """Moves the detected face mesh of a picture to where the estimator sees the head's embedded landmarks."""

    def __init__(self, estimator: str | Path, head: HeadModel) -> None:
        """Read the estimator.

        Raises:
            CheckpointError: the file holds no estimator, or one of another head model.
        """
        check_estimator_head(estimator, head)
        self._estimator = read_estimator(estimator)
        corners = head.uvs[head.uv_faces[head.landmark_faces]]
        uv = (corners * head.landmark_barycentrics[..., None]).sum(1)
        self._uv = torch.stack((uv[:, 0], 1 - uv[:, 1]), -1)
        self._ids = head.landmark_ids.numpy()

    @torch.no_grad()
    def __call__(self, picture: NDArray[np.uint8], landmarks: NDArray[np.float64]) -> NDArray[np.float64]:
        """The face mesh [478,2] of a picture [H,W,3], in pixels; marks that the estimator does not see stay."""
        square = _square(landmarks)
        crop = resample(picture, square, SIDE)
        person = torch.from_numpy((person_mask(crop) > 0.5).astype(np.float32))
        image = torch.from_numpy(crop.astype(np.float32) / 255).permute(2, 0, 1) * person + (1 - person)
        uv = self._estimator(image[None, None])[0, 0].float()
        found, seen = self.places(uv, (person > 0) & torch.isfinite(uv[0]))
        moved = landmarks.copy()
        places = to_photo(found.numpy().astype(np.float64), square, SIDE)
        ids = self._ids[seen.numpy()]
        step = places[seen.numpy()] - landmarks[ids]
        length = np.linalg.norm(step, axis=1)
        kept = length <= _TRUST * max(float(np.median(length)), 1.0) if len(length) else length > 0
        moved[ids[kept]] += step[kept]
        return moved

    def places(self, uv: Tensor, person: Tensor) -> tuple[Tensor, Tensor]:
        """Crop pixels [L,2] that show the landmarks, and which of them [L] are seen."""
        rows, columns = person.nonzero(as_tuple=True)
        if len(rows) < _PIXELS:
            return torch.zeros(len(self._uv), 2), torch.zeros(len(self._uv), dtype=torch.bool)
        pixels = torch.stack((columns, rows), -1) + 0.5
        distance, nearest = torch.cdist(self._uv, uv[:, rows, columns].mT.contiguous()).topk(_PIXELS, largest=False)
        weight = (1 - distance / _NEAR).clamp_min(0)
        total = weight.sum(1, keepdim=True)
        return (pixels[nearest] * weight[..., None]).sum(1) / total.clamp_min(1e-6), total[:, 0] > 1


def _square(landmarks: NDArray[np.float64]) -> Square:
    """The square around the head of a face mesh."""
    low, high = landmarks.min(axis=0), landmarks.max(axis=0)
    side = CROP_TO_HEAD * HEAD_TO_FACE * float((high - low).max())
    x0, y0 = (low + high - side) / 2
    return float(x0), float(y0), side
