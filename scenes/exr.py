"""Named float images in OpenEXR files."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

import numpy as np

_CHANNELS = {
    "linear": ("R", "G", "B"),
    "rgb": ("srgb.R", "srgb.G", "srgb.B"),
    "mask": ("A",),
    "depth": ("Z",),
    "normal": ("normal.X", "normal.Y", "normal.Z"),
    "uv": ("uv.U", "uv.V"),
}


def write_exr(path: str | Path, images: Mapping[str, np.ndarray]) -> None:
    """Write images [H,W] or [H,W,C] as float32 channels; the file appears whole or not at all.

    "linear", "mask" and "depth" become R G B, A and Z as viewers expect them; "rgb", which is sRGB, "normal" and "uv"
    become channels of their own name, and any other image `name.0`, `name.1`, ... Values are stored as they are.

    Raises:
        ValueError: there are no images, or they differ in size.
    """
    openexr = _openexr()
    channels: dict[str, np.ndarray] = {}
    for name, image in images.items():
        layers = image[..., None] if image.ndim == 2 else image
        names = _CHANNELS.get(name) or tuple(f"{name}.{index}" for index in range(layers.shape[-1]))
        if layers.ndim != 3 or layers.shape[-1] != len(names):
            raise ValueError(f"image '{name}' has shape {image.shape}; [H,W] or [H,W,{len(names)}] is needed")
        for index, channel in enumerate(names):
            channels[channel] = np.ascontiguousarray(layers[..., index], dtype=np.float32)
    if len({channel.shape for channel in channels.values()}) != 1:
        raise ValueError("write_exr needs at least one image, all of the same height and width")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    target = Path(path)
    handle, temporary = tempfile.mkstemp(dir=target.parent, suffix=".exr")
    os.close(handle)
    try:
        openexr.File(header, channels).write(temporary)
        Path(temporary).replace(target)
    finally:
        Path(temporary).unlink(missing_ok=True)


def read_exr(path: str | Path) -> dict[str, np.ndarray]:
    """Read what `write_exr` wrote: image name -> [H,W] or [H,W,C] float32.

    Raises:
        ValueError: the file is missing or is not an OpenEXR image.
    """
    openexr = _openexr()
    try:
        with openexr.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
    except (RuntimeError, OSError) as error:
        raise ValueError(f"{path} cannot be read as an OpenEXR image: {error}") from error
    images: dict[str, np.ndarray] = {}
    for name, names in _CHANNELS.items():
        if all(channel in channels for channel in names):
            layers = [channels.pop(channel) for channel in names]
            images[name] = layers[0] if len(layers) == 1 else np.stack(layers, -1)
    for name in sorted({channel.rsplit(".", 1)[0] for channel in channels}):
        layers = [channels[f"{name}.{index}"] for index in range(sum(c.rsplit(".", 1)[0] == name for c in channels))]
        images[name] = layers[0] if len(layers) == 1 else np.stack(layers, -1)
    return images


def _openexr() -> ModuleType:
    try:
        import OpenEXR
    except ImportError as error:
        raise ImportError("EXR files need OpenEXR: install the extra with `pip install uika-drjit[scenes]`") from error
    return OpenEXR


def write_png(path: str | Path, image: np.ndarray) -> None:
    """Write an sRGB image [H,W,3] or a mask [H,W] with values in [0,1] as 8-bit PNG, whole or not at all.

    Raises:
        ValueError: the image has another shape.
    """
    from PIL import Image

    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[-1] not in (1, 3)):
        raise ValueError(f"image has shape {image.shape}; [H,W] or [H,W,3] is needed")
    target = Path(path)
    handle, temporary = tempfile.mkstemp(dir=target.parent, suffix=".png")
    try:
        with os.fdopen(handle, "wb") as file:
            levels = (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
            Image.fromarray(levels.squeeze()).save(file, format="PNG")
        Path(temporary).replace(target)
    finally:
        Path(temporary).unlink(missing_ok=True)
