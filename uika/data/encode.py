"""Images of a capture as PNG bytes: 8-bit colour and masks, 16-bit correspondences and depth."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from typing import Any

import numpy as np

from uika.errors import UikaError, install_command

DEPTH_UNIT = 5e-5  # metres for one step of a stored depth; the largest is 3.28 m
UV_STEPS = 65534  # of a stored texture coordinate; 0 stands for none
_LEVEL = 1  # of compression; higher ones cost more time than the rendering
_QUALITY = 95  # of JPEG; colour keeps its full resolution
_FORMATS = ("PNG", "JPEG", "WEBP")
_MAX_PIXELS = 64_000_000
_UP = 2  # PNG's line filter "Up"
_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def encode_pixels(pixels: np.ndarray) -> bytes:
    """PNG of whole numbers: uint8 [H,W,3], uint8 [H,W] or uint16 [H,W].

    Written here because image libraries try all line filters, which takes as long as rendering; the difference to the
    line above suits these pictures.
    """
    height, width = pixels.shape[:2]
    wide = pixels.dtype == np.uint16
    lines = (pixels.astype(">u2") if wide else pixels).view(np.uint8).reshape(height, -1)
    filtered = np.empty((height, 1 + lines.shape[1]), np.uint8)
    filtered[:, 0] = _UP
    filtered[0, 1:] = lines[0]
    np.subtract(lines[1:], lines[:-1], out=filtered[1:, 1:])
    # Runs are all that deflate's fastest level finds in 8-bit pictures; correspondences repeat more than that.
    packer = zlib.compressobj(_LEVEL, strategy=zlib.Z_DEFAULT_STRATEGY if wide else zlib.Z_RLE)
    body = packer.compress(filtered.data) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, 16 if wide else 8, 2 if pixels.ndim == 3 else 0, 0, 0, 0)
    return _SIGNATURE + b"".join(_chunk(*part) for part in ((b"IHDR", header), (b"IDAT", body), (b"IEND", b"")))


def encode_jpeg(pixels: np.ndarray) -> bytes:
    """JPEG of colours uint8 [H,W,3], with a third of PNG's bytes; losses stay below the noise of a camera."""
    buffer = io.BytesIO()
    _pillow().fromarray(pixels).save(buffer, format="JPEG", quality=_QUALITY, subsampling=0)
    return buffer.getvalue()


def encode_uv(steps: np.ndarray) -> bytes:
    """PNG [2H,W], u above v, of stored correspondences uint16 [H,W,2]: 0 for none, else 1 + round(uv * UV_STEPS)."""
    return encode_pixels(np.concatenate((steps[..., 0], steps[..., 1])))


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
    return np.where(valid[..., None], (steps.astype(np.float32) - 1) / UV_STEPS, 0).astype(np.float32), valid


def decode_depth(data: bytes, name: str) -> np.ndarray:
    """Camera depths float32 [H,W] in metres, 0 for none.

    Raises:
        UikaError: they are not such an image; the message says `name`.
    """
    return (_wide(data, name) * DEPTH_UNIT).astype(np.float32)


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(content, zlib.crc32(kind)))


def _pillow() -> Any:
    try:
        from PIL import Image
    except ImportError as error:
        raise UikaError(f"images need Pillow; run: {install_command('PIL')}") from error
    return Image


def _open(data: bytes, name: str) -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of sizes, judged here
            image = _pillow().open(io.BytesIO(data), formats=_FORMATS)
            if image.width * image.height > _MAX_PIXELS:
                raise UikaError(f"{name}: has {image.width}x{image.height} pixels; {_MAX_PIXELS:,} are the most")
            image.load()
    except UikaError:
        raise
    except Exception as error:  # decoders meet hostile bytes with many exception types
        raise UikaError(f"{name}: is not a readable image ({error})") from error
    return image


def _read(data: bytes, name: str, mode: str) -> np.ndarray:
    return np.array(_open(data, name).convert(mode))


def _wide(data: bytes, name: str) -> np.ndarray:
    image = _open(data, name)
    if image.mode not in ("I;16", "I"):
        raise UikaError(f"{name}: is not a 16-bit image but of mode {image.mode}")
    return np.array(image).astype(np.int64)
