"""Take out what the face mesh detector gets wrong in the same way on everyone when a face is turned."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from uika.assets import LANDMARK_BIAS
from uika.fitting.landmarks import LandmarkFit, eye_distance
from uika.head import HeadModel

DEGREE = 3


def unbiased(landmarks: Tensor, fit: LandmarkFit, head: HeadModel) -> Tensor:
    """Landmarks without the error that the detector is expected to make at each photo's viewing angle.

    The expected errors, beyond those of a frontal view, were measured on renders of known heads
    (`tools/calibrate_detector.py`).

    Args:
        landmarks: [N,478,2] as detected, pixels.
        fit: a fit to them, which tells the viewing angles.
        head: the head model it was made with.

    Returns:
        [N,478,2] pixels.
    """
    rotation, depth = fit.rotation.double(), fit.translation[:, 2].double()
    unit = fit.focal.double() * eye_distance(head) / depth
    error = torch.einsum("nf,flc->nlc", view_polynomials(-rotation[:, 2]), detector_bias()) * unit[:, None, None]
    return (landmarks.double() - error @ upright(rotation)).to(landmarks.dtype)


def view_polynomials(direction: Tensor) -> Tensor:
    """Products [N,F] up to `DEGREE` of x and y of unit directions [N,3] from the head to the camera, in head space."""
    x, y = direction[:, 0], direction[:, 1]
    powers = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    return torch.stack([x**i * y**j for i, j in powers], -1)


def upright(rotation: Tensor) -> Tensor:
    """Turns [N,2,2] of the picture plane that bring the head's up axis upright, from head to camera rotations."""
    up = rotation[:, :2, 1]
    sine, cosine = (up / up.norm(dim=-1, keepdim=True)).unbind(-1)
    return torch.stack((torch.stack((-cosine, sine), -1), torch.stack((-sine, -cosine), -1)), -2)


@lru_cache(maxsize=1)
def detector_bias() -> Tensor:
    """Coefficients [F,478,2] over `view_polynomials`, in outer eye-corner distances of the upright picture."""
    with LANDMARK_BIAS.open("rb") as handle, np.load(handle, allow_pickle=False) as file:
        return torch.from_numpy(file["bias"].astype(np.float64))
