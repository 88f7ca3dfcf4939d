"""One labelled image of a head, wherever it comes from."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from uika.errors import UikaError
from uika.head import Camera, HeadParameters


class DataError(UikaError):
    """A capture, a shard or a file in it that cannot be used; the message names it."""


@dataclass(frozen=True, eq=False)
class Sample:
    """An image with all that is known about it; tensors are float32 unless noted."""

    key: str  # capture, time step and camera
    identity: str  # the same for all images of one person
    timestep: int
    camera_id: str
    image: Tensor  # [3,H,W] sRGB in [0,1], with the backdrop it was taken before
    mask: Tensor  # [H,W] in [0,1], the person
    camera: Camera  # OpenCV axes, metres
    parameters: HeadParameters | None = None  # pose, expression and shape of the tracked head
    static_offset: Tensor | None = None  # [V,3] metres on the unposed head
    uv: Tensor | None = None  # [H,W,2] correspondences with v down, 0 where unknown
    uv_valid: Tensor | None = None  # [H,W] bool
    depth: Tensor | None = None  # [H,W] metres of camera z, 0 for none
