"""Posing an avatar's Gaussians by Dr.Jit: `pose_gaussians` without gradients, for the many frames of one avatar."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, cast

import drjit as dr
import torch
from torch import Tensor

from drjit_splat.llvm import require
from uika.head.binding import FLAT, SCALE_RANGE, SMALL, surface_frames

_RECORD = 16  # floats: barycentric 3, corner ids 3 (as bits), offset from the surface 3, quat 4, scales 3
_REST = 16  # floats: tangent 3, bitangent 3, normal 3, first edge's length, second edge's x, 1 / y or 0, area; padding


class Posed(NamedTuple):
    """Gaussians of one frame as flat Dr.Jit arrays."""

    means: Any  # [M * 3] metres
    quats: Any  # [M * 4] wxyz
    scales: Any  # [M * 3] metres


@dataclass(frozen=True, eq=False)
class Rig:
    """All that posing M Gaussians on a mesh of V vertices and F triangles needs and that no frame changes."""

    count: int  # M
    records: Any  # [M * 16] see _RECORD
    corners: Any  # [F * 4] vertex ids, padded
    rest: Any  # [F * 16] see _REST
    fans: Any  # [V + 1] where each vertex's triangles start in `fan_faces`
    fan_faces: Any  # [3 F]
    rest_area: Any  # [V] square metres of the triangles around each vertex

    @staticmethod
    def of(
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        canonical_vertices: Tensor,
        faces: Tensor,
        triangle: Tensor,
        barycentric: Tensor,
    ) -> Rig:
        """Prepare Gaussians; the arguments are those of `pose_gaussians`, on the CPU.

        Raises:
            RuntimeError: no LLVM library was found; the message says what to install.
        """
        require()
        from drjit.llvm import Float, UInt32

        corner = faces[triangle]
        surface = (canonical_vertices[corner] * barycentric[..., None]).sum(1)
        ids = corner.to(torch.int32).view(torch.float32)
        records = torch.cat((barycentric, ids, means - surface, quats, scales), 1)
        order = faces.flatten().argsort(stable=True)
        counts = torch.bincount(faces.flatten(), minlength=len(canonical_vertices))
        fans = torch.cat((counts.new_zeros(1), counts.cumsum(0)))
        _, area = surface_frames(canonical_vertices, faces)
        rest_area = area.new_zeros(len(canonical_vertices)).index_add_(0, faces.flatten(), area.repeat_interleave(3))

        def ints(tensor: Tensor) -> Any:
            return UInt32(tensor.to(torch.int32).flatten().numpy().view("uint32"))

        padded = torch.cat((faces, faces[:, :1]), 1)
        rest = _rest(canonical_vertices, faces)
        return Rig(
            len(means),
            Float(records.float().flatten().numpy()),
            ints(padded),
            Float(rest.float().flatten().numpy()),
            ints(fans),
            ints(order // 3),
            Float(rest_area.float().numpy()),
        )

    def pose(self, vertices: Tensor, turn: Tensor) -> Posed:
        """Gaussians on a posed mesh; the work is queued, not waited for.

        Args:
            vertices: [V,3] metres.
            turn: [4] wxyz, `rigid_turn` from the canonical mesh to this one.
        """
        from drjit.llvm import Float

        points, towards = (Float(given.detach().float().contiguous().view(-1)) for given in (vertices, turn))
        fixed = (self.records, self.corners, self.rest, self.fans, self.fan_faces, self.rest_area)
        run = _recorded(self.count, dr.width(self.corners), dr.width(self.rest_area))
        return Posed(*run(points, towards, *fixed)[:3])

    def _posed(self, points: Any, towards: Any) -> tuple[Any, ...]:
        """What `Posed` holds, and what was made on the way."""
        triangles = self._triangles(points, towards)
        moved = self._vertices(points, triangles)
        return *self._carried(moved), triangles, moved

    def _triangles(self, points: Any, towards: Any) -> Any:
        """Rotation (wxyz) times canonical area, and posed area, of each triangle [F * 8], padded."""
        from drjit.llvm import ArrayXf, Float, UInt32

        count = dr.width(self.corners) // 4
        i = dr.arange(UInt32, count)
        ids = _packet(UInt32, self.corners, i, 4)[:3]
        a, b, c = ([dr.gather(Float, points, 3 * corner + k) for k in range(3)] for corner in ids)
        one, two = _minus(b, a), _minus(c, a)
        rest = [*_packet(Float, self.rest, 2 * i, 8), *_packet(Float, self.rest, 2 * i + 1, 8)]
        (tangent, bitangent, normal), area = _frame(one, two)
        length, x, inverse_y = rest[9:12]
        sound = inverse_y != 0
        stretch = _dot(one, tangent) / length
        shear = (_dot(two, tangent) - stretch * x) * inverse_y
        along = dr.select(sound, stretch + _dot(two, bitangent) * inverse_y, 1)
        across = dr.select(sound, -shear, 0)
        scale = 1 / dr.sqrt(along * along + across * across + SMALL)
        cosine, sine = along * scale, across * scale
        turned = [cosine * t + sine * b for t, b in zip(tangent, bitangent, strict=True)]
        aside = [cosine * b - sine * t for t, b in zip(tangent, bitangent, strict=True)]
        after = (turned, aside, normal)
        matrix = [[sum(axis[r] * rest[3 * k + s] for k, axis in enumerate(after)) for s in range(3)] for r in range(3)]
        quat = _quaternion(matrix)
        # A quaternion and its negative are one rotation; before sums, all lie on the side of the whole mesh's rotation.
        against = _dot(quat, [dr.gather(Float, towards, UInt32(k)) for k in range(4)]) < 0
        weight = dr.select(against, -rest[12], rest[12])
        values = [*(weight * q for q in quat), area, *[Float(0)] * 3]
        result = dr.empty(Float, 8 * count)
        dr.scatter(result, ArrayXf(values), i, mode=dr.ReduceMode.Permute)
        dr.eval(result)
        return result

    def _vertices(self, points: Any, triangles: Any) -> Any:
        """Position, rotation (wxyz) and growth of each vertex [V * 8]."""
        from drjit.llvm import ArrayXf, Float, UInt32

        count = dr.width(self.rest_area)
        i = dr.arange(UInt32, count)
        start, end = dr.gather(UInt32, self.fans, i), dr.gather(UInt32, self.fans, i + 1)

        def add(k: Any, *sums: Any) -> tuple[Any, ...]:
            part = _packet(Float, triangles, dr.gather(UInt32, self.fan_faces, k), 8)
            return k + 1, *(total + value for total, value in zip(sums, part[:5], strict=True))

        state = (start, *(Float(0) for _ in range(5)))
        result: Any = dr.while_loop(state, lambda k, *_: k < end, cast(Any, add), mode="symbolic")
        _, *quat, area = result
        rotation = _unit(quat)
        growth = dr.sqrt((area + SMALL) / (self.rest_area + SMALL))
        growth = dr.select(growth < SCALE_RANGE[0], SCALE_RANGE[0], growth)
        growth = dr.select(growth > SCALE_RANGE[1], SCALE_RANGE[1], growth)
        values = [*(dr.gather(Float, points, 3 * i + k) for k in range(3)), *rotation, growth]
        table = dr.empty(Float, 8 * count)
        dr.scatter(table, ArrayXf(values), i, mode=dr.ReduceMode.Permute)
        dr.eval(table)
        return table

    def _carried(self, vertices: Any) -> Posed:
        from drjit.llvm import ArrayXf, Float, UInt32

        i = dr.arange(UInt32, self.count)
        record = [*_packet(Float, self.records, 2 * i, 8), *_packet(Float, self.records, 2 * i + 1, 8)]
        moved = [Float(0)] * 8
        for weight, bits in zip(record[:3], record[3:6], strict=True):
            corner = _packet(Float, vertices, dr.reinterpret_array(UInt32, bits), 8)
            moved = [dr.fma(weight, value, total) for value, total in zip(corner, moved, strict=True)]
        w, *xyz = _unit(moved[3:7])
        offset = record[6:9]
        v, *uvw = record[9:13]
        twice = [2 * value for value in _cross(xyz, offset)]
        further = _cross(xyz, twice)
        both = _cross(xyz, uvw)
        means, quats, scales = (dr.empty(Float, size * self.count) for size in (3, 4, 3))
        for k in range(3):
            mean = moved[k] + offset[k] + dr.fma(w, twice[k], further[k])
            dr.scatter(means, mean, 3 * i + k, mode=dr.ReduceMode.Permute)
            dr.scatter(scales, moved[7] * record[13 + k], 3 * i + k, mode=dr.ReduceMode.Permute)
        quat = [w * v - _dot(xyz, uvw), *(dr.fma(w, uvw[k], dr.fma(v, xyz[k], both[k])) for k in range(3))]
        dr.scatter(quats, ArrayXf(quat), i, mode=dr.ReduceMode.Permute)
        dr.eval(means, quats, scales)
        return Posed(means, quats, scales)


@lru_cache(maxsize=8)
def _recorded(count: int, corners: int, vertices: int) -> Callable[..., Any]:
    """Posing on heads of one size, traced at the first call: tracing takes as long as the kernels run."""

    # Repeating a trace goes wrong where an array that is written to is not among the results.
    @dr.freeze(state_fn=None)
    def run(points: Any, towards: Any, *fixed: Any) -> tuple[Any, ...]:
        return Rig(count, *fixed)._posed(points, towards)

    return run


def _rest(vertices: Tensor, faces: Tensor) -> Tensor:
    """Constants [F,16] of the canonical triangles, see `_REST`; 1 / y is 0 where a triangle has no extent."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    frame, area = surface_frames(vertices, faces)
    tangent, bitangent = frame[..., 0], frame[..., 1]
    length, x, y = ((b - a) * tangent).sum(-1), ((c - a) * tangent).sum(-1), ((c - a) * bitangent).sum(-1)
    sound = (length.abs() > SMALL) & (y.abs() > SMALL)
    inverse = torch.where(sound, 1 / torch.where(sound, y, 1.0), 0.0)
    plane = torch.stack((torch.where(sound, length, 1.0), x, inverse, area), -1)
    return torch.cat((frame.mT.flatten(1), plane, plane.new_zeros(len(faces), 3)), -1)


def _frame(first: list[Any], second: list[Any]) -> tuple[tuple[list[Any], list[Any], list[Any]], Any]:
    """Tangent, bitangent, normal and area of a triangle from two edges; see `surface_frames`."""
    cross = _cross(first, second)
    twice_area = dr.sqrt(_dot(cross, cross))
    one, two = _dot(first, first), _dot(second, second)
    longest = dr.select(one > two, one, two)
    sound = (twice_area > FLAT * longest) & (twice_area > SMALL)
    tangent = _unit([dr.select(sound, value, float(k == 0)) for k, value in enumerate(first)])
    normal = _unit([dr.select(sound, value, float(k == 2)) for k, value in enumerate(cross)])
    tilt = _dot(normal, tangent)
    normal = _unit([n - tilt * t for n, t in zip(normal, tangent, strict=True)])
    return (tangent, _cross(normal, tangent), normal), twice_area / 2


def _quaternion(m: list[list[Any]]) -> list[Any]:
    """Unit quaternion (wxyz, any sign) of a rotation: of the four exact formulas the one with the largest divisor."""
    xx, yy, zz = m[0][0], m[1][1], m[2][2]
    x, y, z = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    xy, xz, yz = m[0][1] + m[1][0], m[0][2] + m[2][0], m[1][2] + m[2][1]
    squares = [1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz]
    rows = [[squares[0], x, y, z], [x, squares[1], xy, xz], [y, xy, squares[2], yz], [z, xz, yz, squares[3]]]
    best, chosen = squares[0], rows[0]
    for square, row in zip(squares[1:], rows[1:], strict=True):
        better = square > best
        best = dr.select(better, square, best)
        chosen = [dr.select(better, new, old) for new, old in zip(row, chosen, strict=True)]
    return _unit(chosen)


def _packet(kind: Any, source: Any, index: Any, size: int) -> list[Any]:
    from drjit.llvm import ArrayXf, ArrayXu

    array = ArrayXu if dr.is_integral_v(kind) else ArrayXf
    values: Any = dr.gather(array, source, index, shape=(size, dr.width(index)))
    return [values[k] for k in range(size)]


def _minus(one: list[Any], other: list[Any]) -> list[Any]:
    return [a - b for a, b in zip(one, other, strict=True)]


def _dot(one: list[Any], other: list[Any]) -> Any:
    total = one[0] * other[0]
    for a, b in zip(one[1:], other[1:], strict=True):
        total = dr.fma(a, b, total)
    return total


def _cross(one: list[Any], other: list[Any]) -> list[Any]:
    (a, b, c), (d, e, f) = one, other
    return [b * f - c * e, c * d - a * f, a * e - b * d]


def _unit(values: list[Any]) -> list[Any]:
    squared = _dot(values, values)
    inverse = 1 / dr.sqrt(dr.select(squared < SMALL**2, SMALL**2, squared))
    return [value * inverse for value in values]
