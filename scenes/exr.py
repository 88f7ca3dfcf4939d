"""Named float images in OpenEXR files."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

import numpy as np

_CHANNELS = {"rgb": ("R", "G", "B"), "mask": ("A",), "depth": ("Z",), "uv": ("uv.U", "uv.V")}


def write_exr(path: str | Path, images: Mapping[str, np.ndarray]) -> None:
    """Write images [H,W] or [H,W,C] as float32 channels; the file appears whole or not at all.

    "rgb", "mask", "depth" and "uv" become R G B, A, Z and uv.U uv.V; any other image becomes channels `name.0`,
    `name.1`, ... Values are stored as they are, so "rgb" from `render` stays sRGB.

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
