"""The full-quality picture beside the browser's."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uika.avatar import Avatar
from uika.avatar.rendering import render
from uika.head import Camera, HeadModel, HeadParameters
from uika.head.rotations import quaternions_to_matrices
from uika.metrics import psnr
from uika.viewer.live import UNITS

_GAIN = 8.0  # of the difference that is shown


def compare(
    avatar: Avatar, head: HeadModel, params: HeadParameters, shot: NDArray[np.uint8], view: tuple[Any, Any, float]
) -> tuple[Tensor, Tensor, float]:
    """Render what the browser shows.

    Args:
        avatar: the avatar.
        head: its head model.
        params: the pose.
        shot: [H,W,3 or 4] the browser's picture; where it is transparent it counts as white.
        view: the browser's camera: rotation (wxyz, camera to world, OpenCV axes), position in the page's units, and
            vertical field of view in radians.

    Returns:
        The picture [H,W,3] and the enlarged absolute difference [H,W,3], both in [0,1], and the browser's PSNR in dB.
    """
    height, width = shot.shape[:2]
    browser = torch.from_numpy(shot.copy()).float() / 255
    if browser.shape[-1] == 4:
        browser = browser[..., :3] * browser[..., 3:] + 1 - browser[..., 3:]
    picture = render(avatar, params, camera_of(view, width, height), head).rgb.clamp(0, 1)
    difference = ((picture - browser).abs() * _GAIN).clamp(0, 1)
    return picture, difference, psnr(browser, picture)


def camera_of(view: tuple[Any, Any, float], width: int, height: int) -> Camera:
    """A camera in metres from the browser's rotation, position and field of view."""
    turn = quaternions_to_matrices(torch.as_tensor(np.asarray(view[0]), dtype=torch.float64))
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = turn.T
    viewmat[:3, 3] = -turn.T @ torch.as_tensor(np.asarray(view[1]), dtype=torch.float64) / UNITS
    focal = height / 2 / math.tan(view[2] / 2)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(viewmat.float(), K, width, height)
