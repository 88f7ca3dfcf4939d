"""The `.splat` format of web viewers: 32 bytes for each splat, no header and no harmonics, Y down."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ._inputs import check_finite
from .constants import SH_C0
from .ply import SplatFile

_LAYOUT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])


def load_splat(path: str | os.PathLike[str]) -> SplatFile:
    """Read a file in its own order and axes; rotations, colours and opacities have 8 bits.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is cut short, or holds a NaN or an infinity; the message names it.
    """
    path = Path(path)
    if path.stat().st_size % _LAYOUT.itemsize:
        raise ValueError(f"{path}: is cut short or no .splat file (its size is no multiple of {_LAYOUT.itemsize})")
    table = np.fromfile(path, _LAYOUT)
    means, scales = (torch.from_numpy(table[name].copy()) for name in ("mean", "scale"))
    try:
        check_finite(means=means, scales=scales)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    rgba = torch.from_numpy(table["color"].copy()).float() / 255
    quats = torch.nn.functional.normalize((torch.from_numpy(table["quat"].copy()).float() - 128) / 128, dim=-1)
    return SplatFile(means, quats, scales, rgba[:, 3].contiguous(), ((rgba[:, :3] - 0.5) / SH_C0)[:, None])


def save_splat(
    path: str | os.PathLike[str],
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [N, 3]
) -> None:
    """Write a file, the largest and most opaque splats first, as viewers that load step by step expect.

    It appears under its name only when it is complete.

    Args:
        path: file to write.
        means: [N, 3] centres.
        quats: [N, 4] rotations, wxyz, of any length.
        scales: [N, 3] standard deviations.
        opacities: [N] in [0, 1].
        colors: [N, 3] in [0, 1]; of harmonics, `SplatFile.colors`.

    Raises:
        ValueError: a tensor holds a NaN or an infinity.
    """
    check_finite(means=means, quats=quats, scales=scales, opacities=opacities, colors=colors)
    m, q, s, o, c = (value.detach().cpu() for value in (means, quats, scales, opacities, colors))
    order = (s.prod(-1) * o).argsort(descending=True, stable=True)
    table = np.zeros(len(m), _LAYOUT)
    table["mean"], table["scale"] = m[order].numpy(), s[order].numpy()
    table["color"] = (torch.cat((c, o[:, None]), -1)[order].clamp(0, 1) * 255).round().byte().numpy()
    turns = torch.nn.functional.normalize(q[order], dim=-1)
    table["quat"] = (turns * 128 + 128).round().clamp(0, 255).byte().numpy()
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    try:
        table.tofile(temporary)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
