"""The `.splat` format of web viewers: 32 bytes for each Gaussian, no header, Y down."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from uika.errors import UikaError
from uika.export.splats import Splats
from uika.io.files import check_output, replacing

_LAYOUT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])


def write_splat(path: str | Path, splats: Splats) -> None:
    """Write Gaussians, the largest and most opaque first, as viewers that load step by step expect.

    Args:
        path: `.splat` file.
        splats: Gaussians in the axes that the reader assumes, usually `Splats.half_turned()`. Colours, opacities and
            rotations are rounded to 8 bits.

    Raises:
        UikaError: wrong extension, or nothing can be written there.
    """
    target = check_output(path, ".splat")
    order = (splats.scales.prod(-1) * splats.opacities).argsort(descending=True, stable=True)
    table = np.zeros(len(splats), _LAYOUT)
    table["mean"] = splats.means[order].numpy()
    table["scale"] = splats.scales[order].numpy()
    rgba = torch.cat((splats.colors, splats.opacities[:, None]), -1)[order]
    table["color"] = (rgba.clamp(0, 1) * 255).round().byte().numpy()
    quats = torch.nn.functional.normalize(splats.quats[order], dim=-1)
    table["quat"] = (quats * 128 + 128).round().clamp(0, 255).byte().numpy()
    with replacing(target) as temporary:
        table.tofile(temporary)


def read_splat(path: str | Path) -> Splats:
    """Read what `write_splat` or another program wrote, in the file's order and axes.

    Raises:
        UikaError: no such file, cut short, or with values that are not finite.
    """
    source = Path(path)
    if not source.is_file():
        raise UikaError(f"{source}: no such .splat file")
    if source.stat().st_size % _LAYOUT.itemsize:
        raise UikaError(f"{source}: is cut short or no .splat file (its size is no multiple of {_LAYOUT.itemsize})")
    table = np.fromfile(source, _LAYOUT)
    means, scales = (torch.from_numpy(table[name].copy()) for name in ("mean", "scale"))
    if not bool(torch.isfinite(means).all() and torch.isfinite(scales).all()):
        raise UikaError(f"{source}: holds values that are not finite")
    rgba = torch.from_numpy(table["color"].copy()).float() / 255
    quats = torch.nn.functional.normalize((torch.from_numpy(table["quat"].copy()).float() - 128) / 128, dim=-1)
    return Splats(means, quats, scales, rgba[:, 3].contiguous(), rgba[:, :3].contiguous())
