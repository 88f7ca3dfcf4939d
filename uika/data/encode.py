"""Images of a capture as PNG bytes: 8-bit colour and masks, 16-bit correspondences and depth."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from uika.errors import UikaError, install_command

DEPTH_UNIT = 5e-5  # metres for one step of a stored depth; the largest is 3.28 m
_STEPS = 65534  # of a stored texture coordinate; 0 stands for none
_LEVEL = 1  # of compression; higher ones cost more time than the rendering


def encode_colour(image: np.ndarray) -> bytes:
    """PNG of sRGB [H,W,3] or of a mask [H,W], float in [0,1]."""
    return _png((np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8))


def encode_uv(uv: np.ndarray, valid: np.ndarray) -> bytes:
    """PNG [2H,W] of correspondences [H,W,2] with v down, u above v, and of where they are known [H,W]."""
    steps = np.where(valid[..., None], 1 + np.round(np.clip(uv, 0, 1) * _STEPS), 0).astype(np.uint16)
    return _png(np.concatenate((steps[..., 0], steps[..., 1])))


def encode_depth(depth: np.ndarray) -> bytes:
    """PNG [H,W] of camera depths [H,W] in metres, 0 for none."""
    return _png(np.clip(np.round(depth / DEPTH_UNIT), 0, 65535).astype(np.uint16))


def decode_colour(data: bytes, name: str) -> np.ndarray:
    """Pixels uint8 [H,W,3] of an image file's bytes; alpha is dropped.

    Raises:
        UikaError: they are not an image; the message says `name`.
    """
    return _read(data, name, "RGB")


def decode_mask(data: bytes, name: str) -> np.ndarray:
    """Pixels uint8 [H,W] of a mask file's bytes.

    Raises:
        UikaError: they are not an image; the message says `name`.
    """
    return _read(data, name, "L")


def decode_uv(data: bytes, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Correspondences float32 [H,W,2] (0 for none) and where they are known [H,W].

    Raises:
        UikaError: they are not such an image; the message says `name`.
    """
    stacked = _wide(data, name)
    if len(stacked) % 2:
        raise UikaError(f"{name}: is not a correspondence image; it must hold u above v")
    steps = np.stack((stacked[: len(stacked) // 2], stacked[len(stacked) // 2 :]), -1)
    valid: np.ndarray = np.all(steps > 0, axis=-1)
    return np.where(valid[..., None], (steps.astype(np.float32) - 1) / _STEPS, 0).astype(np.float32), valid


def decode_depth(data: bytes, name: str) -> np.ndarray:
    """Camera depths float32 [H,W] in metres, 0 for none.

    Raises:
        UikaError: they are not such an image; the message says `name`.
    """
    return (_wide(data, name) * DEPTH_UNIT).astype(np.float32)


def _png(array: np.ndarray) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, format="PNG", compress_level=_LEVEL)
    return buffer.getvalue()


def _open(data: bytes, name: str) -> Any:
    try:
        from PIL import Image
    except ImportError as error:
        raise UikaError(f"reading images needs Pillow; run: {install_command('PIL')}") from error
    try:
        image = Image.open(io.BytesIO(data))
        image.load()
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise UikaError(f"{name}: is not a readable image ({error})") from error
    return image


def _read(data: bytes, name: str, mode: str) -> np.ndarray:
    return np.array(_open(data, name).convert(mode))


def _wide(data: bytes, name: str) -> np.ndarray:
    image = _open(data, name)
    if image.mode not in ("I;16", "I"):
        raise UikaError(f"{name}: is not a 16-bit image but of mode {image.mode}")
    return np.array(image).astype(np.int64)
