"""What the projection made of the splats, as tensors."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ._call import Call
from ._core import Trace
from ._project import RECORD
from .constants import LOG2E

BETWEEN = {"means2d": 2, "conics": 3, "depths": 1}
"""What stands between splats and images in torch's graph, and the numbers of each splat."""


def visible_count(trace: Trace, n: int) -> int:
    """Number of splats that are drawn."""
    return 0 if trace.projected is None else n - sum(trace.projected.culled.values())


def visible_rows(call: Call) -> Tensor:
    """[I * N] whether a splat is drawn."""
    parts = [t.projected.visible.torch() for t in call.traces if t.projected is not None]
    return torch.cat(parts) if parts else torch.zeros(0, dtype=torch.bool)


def packed(call: Call, full: Tensor, size: int) -> Tensor:
    """Rows [I * N or nnz, `size`] of values [I, N, `size`]; of visible splats only if the call is packed."""
    rows = full.reshape(-1, size)
    if not call.packed or not len(rows):
        return rows
    if call.rows is None:
        call.rows = visible_rows(call).nonzero()[:, 0]
    return rows[call.rows]


def unpacked(call: Call, rows: Tensor, size: int) -> Tensor:
    """Values [I, N, `size`] of such rows, zero where not visible."""
    if not call.packed:
        return rows.reshape(call.count, -1, size)
    visible = visible_rows(call)
    full = rows.new_zeros(len(visible), size)
    full[visible] = rows.reshape(-1, size)
    return full.view(call.count, -1, size)


def shape_of(call: Call, n: int, size: int) -> tuple[int, ...]:
    """Shape of a result with `size` numbers a splat: [nnz, size] if packed, else [..., C, N, size]; no axis of one."""
    first = (sum(visible_count(t, n) for t in call.traces),) if call.packed else (*call.batch, call.cameras, n)
    return first if size == 1 else (*first, size)


def empty_outputs(call: Call, device: torch.device, n: int) -> tuple[Tensor, ...]:
    """Tensors for the results in between, without values; memory that nobody touches costs nothing."""
    return tuple(torch.empty(shape_of(call, n, size), device=device) for size in BETWEEN.values())


def _conics(records: Tensor) -> Tensor:
    half = 0.5 * LOG2E
    a, d, h = records[:, 2] / half, records[:, 4] / half, records[:, 3]
    return torch.stack([a, a * h, a * h * h + d], -1)


def values(call: Call, name: str, n: int, device: torch.device) -> Tensor:
    """One of `BETWEEN` in its final shape."""
    size = BETWEEN[name]
    middle = torch.tensor([0.5 * call.settings.width, 0.5 * call.settings.height], device=device)
    parts = []
    for trace in call.traces:
        p = trace.projected
        if p is None:
            parts.append(torch.zeros(n, size, device=device))
        elif name == "depths":
            parts.append(p.depths.torch().view(n, 1))
        else:
            records = p.records.torch().view(n, RECORD)
            parts.append(records[:, :2] + middle if name == "means2d" else _conics(records))
    return packed(call, torch.stack(parts), size).reshape(shape_of(call, n, size))


def ids(call: Call, n: int) -> tuple[Tensor, Tensor, Tensor]:
    """Element of the batch, camera and splat of each row of a packed call, int64 [nnz]."""
    index = visible_rows(call).nonzero()[:, 0]
    image = torch.div(index, max(n, 1), rounding_mode="floor")
    return torch.div(image, call.cameras, rounding_mode="floor"), image % call.cameras, index - image * n


def tile_grid(call: Call, tile_size: int) -> tuple[int, int]:
    """Tiles in a row and in a column."""
    return math.ceil(call.settings.width / tile_size), math.ceil(call.settings.height / tile_size)
