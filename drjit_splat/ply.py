"""Splat `.ply` files, the format that 3DGS viewers share, and PlayCanvas's compressed ones."""

from __future__ import annotations

import math
import os
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ._compressed_ply import is_compressed, read_compressed
from ._inputs import check_finite
from ._ply_table import HEADER_LIMIT, Header, read_header, read_rows, vertices
from .constants import SH_C0

_REST = {0: 0, 9: 1, 24: 2, 45: 3}  # number of f_rest properties -> harmonic degree
_NEEDED = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3)))
_QUAT = tuple(f"rot_{i}" for i in range(4))


@dataclass(frozen=True)
class SplatFile:
    """Activated splats, as `rasterization` takes them with `sh_degree=degree`; float32."""

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4] wxyz
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    harmonics: Tensor  # [N, (degree + 1)^2, 3]

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return math.isqrt(self.harmonics.shape[1]) - 1

    @property
    def colors(self) -> Tensor:
        """[N, 3] colours without their view-dependent part: 0.5 + SH_C0 * harmonics[:, 0]."""
        return 0.5 + SH_C0 * self.harmonics[:, 0]


def load_ply(path: str | os.PathLike[str]) -> SplatFile:
    """Read a splat file with harmonics of degree 0 to 3.

    It may be binary, text (further properties and elements are ignored), or compressed in PlayCanvas's chunks.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is no splat file, is cut short, or holds a NaN or an infinity.
    """
    path = Path(path)
    header = read_header(path)
    if is_compressed(header):
        found = SplatFile(**{name: torch.from_numpy(value) for name, value in read_compressed(path, header).items()})
    else:
        found = _read_plain(path, header)
    try:
        check_finite(**vars(found))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return found


def _read_plain(path: Path, header: Header) -> SplatFile:
    element = vertices(path, header)
    count, names = element.count, [name for name, _ in element.properties]
    missing = [name for name in (*_NEEDED, *_QUAT) if name not in names]
    if missing:
        raise ValueError(f"{path} has no property {missing[0]!r}; is it a splat file?")
    rest = sum(name.startswith("f_rest_") for name in names)
    if rest not in _REST or any(f"f_rest_{i}" not in names for i in range(rest)):
        raise ValueError(f"{path} has {rest} f_rest properties; degrees 0 to 3 have 0, 9, 24 or 45")
    table = read_rows(path, header, 1)[0]

    def columns(*chosen: str) -> Tensor:
        return torch.from_numpy(np.stack([table[name].astype(np.float32) for name in chosen], -1))

    harmonics = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if rest:
        # The file keeps all coefficients of red, then of green, then of blue.
        higher = columns(*(f"f_rest_{i}" for i in range(rest))).view(count, 3, rest // 3)
        harmonics = torch.cat([harmonics, higher.transpose(1, 2)], 1)
    return SplatFile(
        columns("x", "y", "z"),
        columns(*_QUAT),
        columns("scale_0", "scale_1", "scale_2").exp(),
        columns("opacity")[:, 0].sigmoid(),
        harmonics.contiguous(),
    )


def save_ply(
    path: str | os.PathLike[str],
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [N, 3] or [N, K, 3]
    *,
    extra: Mapping[str, Tensor] | None = None,  # [N] each
    comments: Sequence[str] = (),
) -> None:
    """Write a splat file that 3DGS viewers read; it appears under its name only when it is complete.

    Args:
        path: file to write.
        means: [N, 3] centres.
        quats: [N, 4] rotations, wxyz.
        scales: [N, 3] standard deviations (stored as logarithms; zeros become 1e-12).
        opacities: [N] in [0, 1] (stored as logits, held 1e-6 away from 0 and 1).
        colors: [N, 3] colours, or [N, K, 3] harmonics with K 1, 4, 9 or 16.
        extra: further float properties by name, one value a splat.
        comments: lines for the header; other characters than printable ASCII become question marks.

    Raises:
        ValueError: a tensor has a wrong shape or holds a NaN or an infinity.
    """
    n = len(means)
    harmonics = ((colors - 0.5) / SH_C0)[:, None] if colors.ndim == 2 else colors
    shapes = {
        "means": (means, (n, 3)),
        "quats": (quats, (n, 4)),
        "scales": (scales, (n, 3)),
        "opacities": (opacities, (n,)),
        "colors": (harmonics, (n, harmonics.shape[1], 3)),
        **{name: (tensor, (n,)) for name, tensor in (extra or {}).items()},
    }
    for name, (tensor, shape) in shapes.items():
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must have the shape {list(shape)}, not {list(tensor.shape)}")
    if harmonics.shape[1] not in (1, 4, 9, 16):
        raise ValueError(f"colors must have 1, 4, 9 or 16 harmonics a channel, not {harmonics.shape[1]}")
    check_finite(means=means, quats=quats, scales=scales, opacities=opacities, colors=colors)
    rest = 3 * (harmonics.shape[1] - 1)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(rest)] + ["opacity", "scale_0", "scale_1", "scale_2", *_QUAT, *(extra or {})]
    parts = [
        means,
        torch.zeros_like(means),
        harmonics[:, 0],
        harmonics[:, 1:].transpose(1, 2).reshape(n, rest),
        torch.logit(opacities.double(), eps=1e-6)[:, None],
        scales.double().clamp_min(1e-12).log(),
        quats,
        *(tensor[:, None] for tensor in (extra or {}).values()),
    ]
    table = torch.cat([part.detach().cpu().to(torch.float32) for part in parts], 1).numpy()
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {_printable(line)}" for line in comments)]
    header += [f"element vertex {n}", *(f"property float {name}" for name in names), "end_header", ""]
    text = "\n".join(header).encode("ascii")
    if len(text) > HEADER_LIMIT:
        raise ValueError(f"comments: the header would have {len(text)} bytes, more than {HEADER_LIMIT}")
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    try:
        with temporary.open("wb") as file:
            file.write(text)
            file.write(np.ascontiguousarray(table, dtype="<f4").tobytes())
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def _printable(text: str) -> str:
    return "".join(letter if " " <= letter <= "~" else "?" for letter in text)
