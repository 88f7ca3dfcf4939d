"""How far two faces are apart for a small free network; no substitute for CSIM, whose ArcFace weights are not free.

The network is Davis King's `dlib_face_recognition_resnet_model_v1` (29 convolutions, 150 x 150 pixels, 128 numbers).
"""

from __future__ import annotations

import json
from functools import lru_cache

import torch
from safetensors import safe_open
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, max_pool2d, pad, relu

from uika.assets import FACE_DESCRIPTOR
from uika.metrics.alignment import aligned

SIDE = 150  # pixels of an aligned face
SAME = 0.6  # the distance below which its author takes two pictures for one person
# dlib's mean face: outer and inner corners of the eyes at the picture's right and left, and the nose's base.
_PLACES = (
    (0.8595674595992, 0.2134981538014),
    (0.6460604764104, 0.2289674387677),
    (0.1205750620789, 0.2137274526848),
    (0.3340850613712, 0.2290642403242),
    (0.4901123135679, 0.6277975316475),
)
_MARKS = (263, 362, 33, 133, 2)  # of the face mesh, in that order
_MARGIN = 0.25  # of the mean face's square, on each side
_MEAN = (122.782, 117.001, 104.298)  # of the photos that it was trained with, 0 to 255
_BLOCKS = (
    *("32_1", "32_2", "32_3", "64_down", "64_1", "64_2", "64_3"),
    *("128_down", "128_1", "128_2", "256_down", "256_1", "256_2", "256_down_out"),
)


@torch.no_grad()
def face_descriptor(image: Tensor, landmarks: Tensor) -> Tensor:
    """The descriptor [128] of the face with `landmarks` [478,2] in a picture [H,W,3] in [0,1]."""
    places = SIDE * (torch.tensor(_PLACES) + _MARGIN) / (1 + 2 * _MARGIN)
    face = aligned(image.float(), landmarks[list(_MARKS)], places, SIDE)
    x = (255 * face - torch.tensor(_MEAN)).permute(2, 0, 1)[None] / 255
    x = max_pool2d(relu(_convolved(x, "conv32_down", 2)), 3, 2)
    for name in _BLOCKS:
        x = _residual(x, f"conv{name}", down="down" in name)
    return x.mean((2, 3))[0] @ _weights()["fc"]


def face_distance(first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor]) -> float:
    """Euclidean distance of two faces' descriptors, each face a picture [H,W,3] and its landmarks [478,2]."""
    return float((face_descriptor(*first) - face_descriptor(*second)).norm())


def _residual(x: Tensor, name: str, *, down: bool) -> Tensor:
    out = _convolved(relu(_convolved(x, f"{name}.conv1", 2 if down else 1)), f"{name}.conv2", 1)
    if not down:
        return relu(out + x)
    pooled = avg_pool2d(x, 2)
    rows, columns = pooled.shape[2] - out.shape[2], pooled.shape[3] - out.shape[3]
    out = pad(out, (0, columns, 0, rows))  # convolutions without a border lose a row and a column that pooling keeps
    return relu(out + pad(pooled, (0, 0, 0, 0, 0, out.shape[1] - pooled.shape[1])))


def _convolved(x: Tensor, name: str, stride: int) -> Tensor:
    weights = _weights()
    filters, bias = weights[f"{name}.conv.filters"], weights[f"{name}.conv.bias"]
    gain, offset = weights[f"{name}.scale.weights"], weights[f"{name}.scale.biases"]
    out = conv2d(x, filters, bias, stride, padding=0 if stride == 2 else filters.shape[-1] // 2)
    return out * gain[:, None, None] + offset[:, None, None]


@lru_cache(1)
def _weights() -> dict[str, Tensor]:
    with safe_open(FACE_DESCRIPTOR, framework="pt") as file:
        ranges = json.loads(file.metadata()["ranges"])
        return {name: file.get_tensor(name).float() * scale + least for name, (scale, least) in ranges.items()}
