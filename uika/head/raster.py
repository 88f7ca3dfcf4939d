"""Which triangle covers each pixel centre: an exact, vectorised triangle rasterizer in plain torch."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor

# Candidate (triangle, pixel) pairs tested at once; bounds the memory to about 0.5 GB.
_CHUNK_PAIRS = 1 << 21


@torch.no_grad()
def rasterize(
    points: Tensor,
    faces: Tensor,
    height: int,
    width: int,
    depth: Tensor | None = None,
    cull: Literal["back", "none"] = "back",
    rule: Literal["watertight", "strict"] = "watertight",
) -> tuple[Tensor, Tensor]:
    """Find the triangle under each pixel centre; not differentiable.

    Args:
        points: [V,2] pixel coordinates, y down, pixel centres at +0.5.
        faces: [F,3] vertex ids.
        height: image height in pixels.
        width: image width in pixels.
        depth: [V] camera z in metres; the nearest triangle wins and barycentrics become perspective-correct.
            Triangles with a corner at or behind the camera are left out. Without depth the lowest triangle id wins.
        cull: "back" keeps the triangles whose corners run counter-clockwise as seen in the image (y down), which are
            those whose outward side faces an OpenCV camera; "none" keeps both sides.
        rule: "watertight" gives a pixel centre on an edge to the lowest of the triangles that share it, so that
            adjoining triangles leave neither gap nor overlap; "strict" leaves such a pixel empty.

    Returns:
        Triangle ids [H,W] int64 with -1 for none, and barycentrics [H,W,3] (zero for none) in the type of `points`.

    Raises:
        ValueError: a shape, size or option is not one of the above.
    """
    if points.ndim != 2 or points.shape[1] != 2 or faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"points {tuple(points.shape)} and faces {tuple(faces.shape)} must be [V,2] and [F,3]")
    if depth is not None and depth.shape != points.shape[:1]:
        raise ValueError(f"depth has shape {tuple(depth.shape)}; one value for each of {len(points)} points is needed")
    if height < 1 or width < 1 or cull not in ("back", "none") or rule not in ("watertight", "strict"):
        raise ValueError(f"cannot rasterize to {width}x{height} pixels with cull={cull!r} and rule={rule!r}")
    corners = points.double()[faces]
    corner_z = None if depth is None else depth.double()[faces]
    boxes, keep = _boxes(corners, corner_z, height, width, cull)
    corners, boxes = corners[keep], boxes[keep]
    corner_z = None if corner_z is None else corner_z[keep]

    nearest = torch.full((height * width,), torch.inf, dtype=torch.float64, device=points.device)
    triangle = torch.full((height * width,), -1, dtype=torch.int64, device=points.device)
    barycentric = torch.zeros(height * width, 3, dtype=points.dtype, device=points.device)
    pairs_before = boxes[:, 2:].prod(-1).cumsum(0)
    for start, stop in _chunks(pairs_before):
        local, pixel, weights, z = _covered(
            corners[start:stop], boxes[start:stop], None if corner_z is None else corner_z[start:stop], width, rule
        )
        local, pixel, weights, z = _front(local, pixel, weights, z, height * width)
        # Chunks run in rising triangle order, so a tie stays with the lower id.
        wins = z < nearest[pixel]
        pixel = pixel[wins]
        nearest[pixel] = z[wins]
        triangle[pixel] = keep[start + local[wins]]
        barycentric[pixel] = weights[wins].to(points.dtype)
    return triangle.view(height, width), barycentric.view(height, width, 3)


def _boxes(corners: Tensor, corner_z: Tensor | None, height: int, width: int, cull: str) -> tuple[Tensor, Tensor]:
    """Pixel boxes [F,4] (x0, y0, columns, rows) and the ids of the triangles that can cover a pixel centre."""
    size = torch.tensor([width, height], dtype=torch.float64, device=corners.device)
    finite = corners.isfinite().all(-1).all(-1)
    safe = torch.where(finite[:, None, None], corners, 0.0)
    first = (safe.amin(1) - 0.5).ceil().clamp_min(0)
    last = torch.minimum((safe.amax(1) - 0.5).floor(), size - 1)
    a, b, c = safe.unbind(1)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    visible = finite & (last >= first).all(-1) & ((area < 0) if cull == "back" else (area != 0))
    if corner_z is not None:
        visible &= (corner_z > 0).all(-1)
    keep = visible.nonzero()[:, 0]
    spans = (last - first + 1).clamp_min(0)
    return torch.cat((first.clamp_max(1e9), spans), -1).long(), keep


def _chunks(pairs_before: Tensor) -> list[tuple[int, int]]:
    """Runs of triangles with about `_CHUNK_PAIRS` candidate pixels each."""
    if not len(pairs_before):
        return []
    total = int(pairs_before[-1])
    marks = _CHUNK_PAIRS * torch.arange(1, -(-total // _CHUNK_PAIRS), device=pairs_before.device)
    cuts = [0, *torch.searchsorted(pairs_before, marks).tolist(), len(pairs_before)]
    return [(start, stop) for start, stop in pairwise(cuts) if stop > start]


def _covered(
    corners: Tensor, boxes: Tensor, corner_z: Tensor | None, width: int, rule: str
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """All (triangle, pixel) pairs inside, with barycentrics [P,3] and depth [P] (zero without `corner_z`)."""
    counts = boxes[:, 2] * boxes[:, 3]
    local = torch.repeat_interleave(torch.arange(len(boxes), device=boxes.device), counts)
    step = torch.arange(len(local), device=boxes.device) - (counts.cumsum(0) - counts)[local]
    columns = boxes[:, 2][local]
    row = torch.div(step, columns, rounding_mode="floor")
    x = boxes[:, 0][local] + step - row * columns
    y = boxes[:, 1][local] + row
    edges = [_edge(corners[:, i], corners[:, (i + 1) % 3], local, x + 0.5, y + 0.5) for i in range(3)]
    # A clockwise triangle has negative edge values throughout; its own orientation makes the inside positive.
    a, b, c = corners.unbind(1)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    sign = area.sign()[local]
    values = torch.stack((edges[1] * sign, edges[2] * sign, edges[0] * sign), -1)
    inside = (values > 0).all(-1) if rule == "strict" else (values >= 0).all(-1) & (values.sum(-1) > 0)
    local, weights = local[inside], values[inside]
    pixel = y[inside] * width + x[inside]
    if corner_z is None:
        return local, pixel, weights / weights.sum(-1, keepdim=True), torch.zeros_like(weights[:, 0])
    flat = weights / weights.sum(-1, keepdim=True)
    scaled = flat / corner_z[local]
    inverse_z = scaled.sum(-1)
    return local, pixel, scaled / inverse_z[:, None], 1 / inverse_z


def _edge(start: Tensor, end: Tensor, local: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Edge function of each pair, exactly negated when the edge is run the other way."""
    # Evaluating from the same end for both triangles of an edge is what makes the rule watertight.
    swap = (start[:, 0] > end[:, 0]) | ((start[:, 0] == end[:, 0]) & (start[:, 1] > end[:, 1]))
    origin = torch.where(swap[:, None], end, start)
    run = torch.where(swap[:, None], start, end) - origin
    sign = torch.where(swap, -1.0, 1.0)
    run_x, run_y, origin_x, origin_y = run[:, 0], run[:, 1], origin[:, 0], origin[:, 1]
    value = run_x[local] * (y - origin_y[local]) - run_y[local] * (x - origin_x[local])
    return value * sign[local].to(value.dtype)


def _front(
    local: Tensor, pixel: Tensor, weights: Tensor, z: Tensor, pixels: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Keep one pair for each pixel: the nearest, then the lowest triangle."""
    nearest = torch.full((pixels,), torch.inf, dtype=z.dtype, device=z.device)
    nearest.scatter_reduce_(0, pixel, z, "amin")
    first = z == nearest[pixel]
    local, pixel, weights, z = local[first], pixel[first], weights[first], z[first]
    lowest = torch.full((pixels,), torch.iinfo(torch.int64).max, dtype=torch.int64, device=z.device)
    lowest.scatter_reduce_(0, pixel, local, "amin")
    first = local == lowest[pixel]
    return local[first], pixel[first], weights[first], z[first]
