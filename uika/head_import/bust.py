"""The built-in head's bust, glued to another head: cut off below its neck's rim, drawn to that and stitched to it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from uika.head import HeadError, HeadModel
from uika.head.bust import TORSO, Bust
from uika.head.files import builtin_head
from uika.head_import.clip import Array, Cut, Ids, clip
from uika.head_import.landmark_embedding import nearest

GAP = 0.01  # metres between the head's rim and the cut below it
AROUND = 1.35  # radii of the rim beyond which nothing is cut off: shoulders may be higher than the rim in front
BACK_PULL = 0.02  # towards no displacement, over an edge's pull: what the rim does dies away within a few edges
LIKENESS = 12  # landmarks that two heads must share to be aligned
MOST = 0.06  # metres by which a rim may lie off the bust
FAR = 0.2  # of a tile: points farther apart lie on different sides of the atlas's seam


@dataclass(frozen=True)
class _Rim:
    """A loop around the neck in order of its angle; `ids` [R] of vertices, angles [R], middle [3]."""

    ids: Ids
    angle: Array
    middle: Array


def with_bust(head: HeadModel) -> HeadModel:
    """A head, with landmarks and joints at its place in space, continued by neck, shoulders and chest.

    Neck and shoulders go on from the head's rim: its shape, its joints' weights and pose correctives die away on them.
    The bust has the second tile of the atlas, u in [1,2].

    Args:
        head: a head without bust whose mesh is open below the neck.

    Raises:
        HeadError: the neck does not end in a rim that the bust fits.
    """
    source = builtin_head()
    assert source.bust is not None
    scale, shift = _similarity(source, head)
    points = scale * source.template.double().numpy() + shift
    faces, uv_faces = (index[source.bust.face :].numpy() for index in (source.faces, source.uv_faces))
    own = head.template.double().numpy()
    rim = _lowest_rim(head)
    triangles = torch.from_numpy(faces)
    on_rim = torch.from_numpy(own[rim.ids]).float()
    whole = torch.from_numpy(points).float()
    triangle, mix, distance = nearest(on_rim, whole, triangles)
    if float(distance.max()) > MOST:
        away = float(distance.max())
        raise HeadError(f"head '{head.id}': its neck ends {away:.2f} m off the built-in bust's; import it without bust")

    cut = clip(_below_rim(points, own, rim), faces, source.uvs.double().numpy(), uv_faces)
    places = cut.of(points)
    upper = _upper_rim(cut, places, rim)
    strip = _stitched(upper, rim, len(own))
    textures = _Textures(points, faces, source.uvs.double().numpy(), uv_faces, cut)
    strip_uvs = textures.of(strip, places, own)

    count = len(own)
    spread = _Spread(np.concatenate((cut.faces + count, strip)), count, len(places), rim.ids)
    off = spread.of(own[rim.ids] - (points[faces[triangle.numpy()]] * mix.double().numpy()[..., None]).sum(1))
    weights = cut.of(source.lbs_weights.double().numpy())
    at_rim = (source.lbs_weights.double().numpy()[faces[triangle.numpy()]] * mix.double().numpy()[..., None]).sum(1)
    weights = (weights + spread.of(head.lbs_weights.double().numpy()[rim.ids] - at_rim)).clip(0)
    kept = 1 - spread.of(np.ones((len(rim.ids), 1)))
    shapes = np.zeros((len(source.bust.modes), len(points), 3))
    shapes[:, source.bust.vertex :] = source.bust.modes.double().numpy()
    modes = cut.of(shapes) * scale * kept

    def continued(values: Tensor) -> Tensor:
        known = values[:, rim.ids].double().permute(1, 0, 2).flatten(1).numpy()
        found = spread.of(known).reshape(len(places), len(values), 3).transpose(1, 0, 2)
        return torch.cat((values, torch.from_numpy(found).float()), 1)

    masks = {name: torch.cat((mask, mask.new_zeros(len(places)))) for name, mask in head.masks.items()}
    masks[TORSO] = torch.cat((torch.zeros(count), torch.ones(len(places))))
    return replace(
        head,
        id=f"{head.id}-bust",
        template=torch.cat((head.template, torch.from_numpy(places + off).float())),
        identity_basis=continued(head.identity_basis),
        expression_basis=continued(head.expression_basis),
        pose_basis=None if head.pose_basis is None else continued(head.pose_basis),
        faces=torch.cat((head.faces, torch.from_numpy(np.concatenate((cut.faces + count, strip))))),
        uvs=torch.cat((head.uvs, torch.from_numpy(np.concatenate((cut.uvs, textures.added))).float())),
        uv_faces=torch.cat(
            (head.uv_faces, torch.from_numpy(np.concatenate((cut.uv_faces, strip_uvs))) + len(head.uvs))
        ),
        lbs_weights=torch.cat((head.lbs_weights, torch.from_numpy(weights / weights.sum(1, keepdims=True)).float())),
        masks=masks,
        bust=Bust(head.id, count, len(head.faces), len(head.uvs), torch.from_numpy(modes).float()),
    )


def _similarity(source: HeadModel, head: HeadModel) -> tuple[float, Array]:
    """Size and shift [3] that bring one head's landmarks to another's."""
    mine, yours = (
        dict(zip(h.landmark_ids.tolist(), h.landmarks(h.template).double().numpy(), strict=True))
        for h in (source, head)
    )
    both = sorted(mine.keys() & yours.keys())
    if len(both) < LIKENESS:
        raise HeadError(
            f"head '{head.id}': shares {len(both)} landmarks with the built-in head; {LIKENESS} are needed for a bust"
        )
    one, other = np.array([mine[i] for i in both]), np.array([yours[i] for i in both])
    size = float(np.linalg.norm(other - other.mean(0)) / np.linalg.norm(one - one.mean(0)))
    return size, other.mean(0) - size * one.mean(0)


def _lowest_rim(head: HeadModel) -> _Rim:
    """The open rim of a mesh that lies lowest.

    Raises:
        HeadError: the mesh has no open rim.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    border = _border(head.faces.numpy())
    if not len(border):
        raise HeadError(
            f"head '{head.id}': its mesh is closed; a bust needs a neck with an open rim; import it without"
        )
    ids, places = np.unique(border, return_inverse=True)
    places = places.reshape(-1, 2)
    graph = coo_matrix((np.ones(len(places)), places.T), shape=(len(ids),) * 2)
    part = connected_components(graph, directed=False)[1]
    heights = head.template[ids, 1].double().numpy()
    lowest = np.argmin(np.bincount(part, heights) / np.bincount(part))
    return _ordered(ids[part == lowest], head.template.double().numpy())


def _border(faces: Ids) -> Ids:
    """Edges [E,2] of one triangle only."""
    edges = np.sort(np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]])), 1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    return unique[count == 1]


def _ordered(ids: Ids, points: Array, middle: Array | None = None) -> _Rim:
    middle = points[ids].mean(0) if middle is None else middle
    away = points[ids] - middle
    angle = np.arctan2(away[:, 0], away[:, 2])
    order = np.argsort(angle)
    return _Rim(ids[order], angle[order], middle)


def _below_rim(points: Array, own: Array, rim: _Rim) -> Array:
    """How far below the cut [V] points [V,3] lie, in metres; negative above it."""
    away = points - rim.middle
    angle = np.arctan2(away[:, 0], away[:, 2])
    at = own[rim.ids] - rim.middle
    level = np.interp(angle, rim.angle, own[rim.ids, 1], period=2 * np.pi) - GAP
    radius = np.interp(angle, rim.angle, np.hypot(at[:, 0], at[:, 2]), period=2 * np.pi)
    return np.maximum(level - points[:, 1], np.hypot(away[:, 0], away[:, 2]) - AROUND * radius)


def _upper_rim(cut: Cut, places: Array, rim: _Rim) -> _Rim:
    """The rim that the cut left below the head's."""
    border = np.unique(_border(cut.faces))
    new = border[(cut.one[border] != cut.other[border])]
    return _ordered(new, places, rim.middle)


def _stitched(upper: _Rim, rim: _Rim, count: int) -> Ids:
    """Triangles [T,3] between the head's rim and the bust's, whose vertices follow the head's `count`."""
    above, below = len(rim.ids), len(upper.ids)
    gap = np.angle(np.exp(1j * (upper.angle - rim.angle[0])))
    start = int(np.argmin(np.abs(gap)))
    high = np.append(rim.angle, rim.angle[0] + 2 * np.pi)
    low = rim.angle[0] + gap[start] + (np.roll(upper.angle, -start) - upper.angle[start]) % (2 * np.pi)
    low = np.append(low, low[0] + 2 * np.pi)
    lower = np.roll(upper.ids, -start) + count
    i = j = 0
    triangles = []
    while i < above or j < below:
        a, b = rim.ids[i % above], lower[j % below]
        if j == below or (i < above and high[i + 1] <= low[j + 1]):
            triangles.append((a, b, rim.ids[(i + 1) % above]))
            i += 1
        else:
            triangles.append((a, b, lower[(j + 1) % below]))
            j += 1
    return np.array(triangles)


class _Textures:
    """Where a strip between rims lies in the atlas: where the mesh that was cut off there had it."""

    def __init__(self, points: Array, faces: Ids, uvs: Array, uv_faces: Ids, cut: Cut) -> None:
        self.points, self.faces, self.uvs, self.uv_faces, self.cut = points, faces, uvs, uv_faces, cut
        self.added = np.zeros((0, 2))

    def of(self, strip: Ids, places: Array, own: Array) -> Ids:
        """Texture corners [T,3] of triangles [T,3], into those of the cut and then `added`."""
        points = np.concatenate((own, places))[strip]
        middle = self._triangles(points.mean(1))
        corner = self._triangles(points.reshape(-1, 3)).reshape(-1, 3)
        found = np.empty((*strip.shape, 2))
        for k in range(3):
            direct = self._at(corner[:, k], points[:, k])
            along = self._at(middle, points[:, k])
            other_side = np.linalg.norm(direct - along, axis=1) > FAR
            found[:, k] = np.where(other_side[:, None], along, direct)
        self.added = found.reshape(-1, 2)
        return len(self.cut.uvs) + np.arange(found.shape[0] * 3).reshape(-1, 3)

    def _triangles(self, points: Array) -> Ids:
        vertices, faces = torch.from_numpy(self.points).float(), torch.from_numpy(self.faces)
        return nearest(torch.from_numpy(points).float(), vertices, faces)[0].numpy()

    def _at(self, triangle: Ids, points: Array) -> Array:
        """Texture coordinates [N,2] of points [N,3] in the planes of triangles [N]."""
        a, b, c = self.points[self.faces[triangle]].transpose(1, 0, 2)
        edges = np.stack((b - a, c - a), -1)
        mix = (np.linalg.pinv(edges) @ (points - a)[..., None])[..., 0]
        u, v, w = self.uvs[self.uv_faces[triangle]].transpose(1, 0, 2)
        return u + mix[:, :1] * (v - u) + mix[:, 1:] * (w - u)


class _Spread:
    """How what happens at a rim dies away on the B vertices below."""

    def __init__(self, faces: Ids, first: int, count: int, rim: Ids) -> None:
        from scipy.sparse import coo_matrix, diags
        from scipy.sparse.linalg import splu

        total = first + count
        row, column = np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]])).T
        graph: Any = coo_matrix((np.ones(len(row)), (row, column)), shape=(total, total)).tocsr()
        graph = (graph + graph.T).minimum(1)[first:]
        degree = np.asarray(graph.sum(1)).ravel()
        self._held = graph[:, rim]
        self._solver = splu((diags(degree * (1 + BACK_PULL)) - graph[:, first:]).tocsc())

    def of(self, values: Array) -> Array:
        """Values [B,C] below a rim that has values [R,C]."""
        return self._solver.solve(np.ascontiguousarray(self._held @ values))
