"""One splat for each pixel that a photo shows outside the fitted surface, and for its outermost hair.

The head model has no strands, curls, buns, collars or hats; displacement along its normals meets the outline and no
more. What the matte shows beyond is put behind and before the outline as a rounded body, bound to the scalp or to the
body below, so that it moves along and can be looked at from the side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from uika.avatar import Avatar
from uika.head import HeadModel, unpose_gaussians
from uika.head.bust import above_cut, fade
from uika.head.rotations import matrices_to_quaternions
from uika.photo_splats.footprints import footprints
from uika.photo_splats.layers import SPREAD, Layers, PhotoView, missing, opacities
from uika.photo_splats.volume import APART, agreed_depth, agreed_volume, carved, half_thickness, unprojected

__all__ = ["LIMIT", "PhotoView", "frontal", "with_photo_splats"]

LIMIT = 60_000  # splats by default
HEAD_SHARE = 0.6  # of the limit, for head and hair
RISE = 0.002  # metres by which splats of the outermost hair lie before the surface
BEHIND = 0.004  # metres by which others lie behind its thin edge
LEAST_OPACITY = 0.03
CLEAR = 0.03  # metres around the face that clothes leave free
VOLUME_STEP = 3  # pixels between splats inside hair that several photos agree on
VOLUME_OPACITY = 0.5  # of each: several lie behind one another
VOLUME_SHARE = 0.25  # of all splats at most
NAPE = 24  # triangles that carry what lies below a head without bust
SEEN_WELL = 0.45  # cosine from which another photo sees the surface well enough to need no rim of this one
NECK = (0.0, -0.10, -0.075)  # metres in the head's axes: middle of the neck above the shoulders
SHOULDERS, CHEST, SLOPE = 0.22, 0.055, 0.25  # half width and depth in metres of a body without bust, and its fall


@dataclass(frozen=True, eq=False)
class _Splats:
    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    triangle: Tensor


@torch.no_grad()
def with_photo_splats(
    avatar: Avatar, head: HeadModel, views: Sequence[PhotoView], limit: int = LIMIT, body: PhotoView | None = None
) -> Avatar:
    """The avatar with splats for what its photos show outside its surface.

    Args:
        avatar: the surface as splats.
        head: its head model.
        views: N photos; what they show beside the head is left to `body` or comes from the most frontal one, since
            heads turn on their bodies.
        limit: number of splats that are added at most.
        body: a wider crop of the most frontal photo, which shows the shoulders too.
    """
    front = frontal(views)
    several = len(views) > 1
    layers = [
        missing(avatar, head, view, clothes=body is None and n == front, relit=several) for n, view in enumerate(views)
    ]
    chosen = [_chosen(head, layers, views, n) for n in range(len(views))]
    canonical = avatar.canonical_vertices(head)
    carriers = _carriers(head)
    share = int(HEAD_SHARE * limit)
    stride = _stride(chosen, round((1 - VOLUME_SHARE) * share) if several else share)
    parts = [
        part
        for n in range(len(views))
        for part in _of_photo(head, canonical, carriers, views, layers, n, chosen[n], stride)
    ]
    if several:
        parts += _volume(head, canonical, carriers[0], views, layers, round(VOLUME_SHARE * share))
    result = _joined(avatar, parts)
    if body is None:
        return result
    lacking = missing(result, head, body, clothes=True, relit=several)
    worn = lacking.outside & ~lacking.hair
    stride = _stride([worn], limit - (len(result) - len(avatar)))
    return _joined(result, _of_photo(head, canonical, carriers, [body], [lacking], 0, worn, stride))


def frontal(views: Sequence[PhotoView]) -> int:
    """The index of the most frontal photo."""
    facing = [float(-view.camera.viewmat[2, 2]) for view in views]
    return max(range(len(views)), key=facing.__getitem__)


def _joined(avatar: Avatar, parts: Sequence[_Splats]) -> Avatar:
    if not sum(len(part.means) for part in parts):
        return avatar
    added: dict[str, Any] = {
        name: torch.cat([getattr(avatar, name), *(getattr(part, name) for part in parts)])
        for name in ("means", "quats", "scales", "opacities", "colors", "triangle")
    }
    middle = torch.full((len(added["means"]) - len(avatar), 3), 1 / 3)
    return replace(avatar, **added, barycentric=torch.cat((avatar.barycentric, middle)))


def _chosen(head: HeadModel, layers: Sequence[Layers], views: Sequence[PhotoView], n: int) -> Tensor:
    """Pixels [S,S] of photo n that get a splat: the rim only where no other photo sees that surface better."""
    own = layers[n]
    rim = own.rim.clone()
    row, column = torch.nonzero(rim, as_tuple=True)
    points = unprojected(views[n], own.depth)[row, column]
    corners = own.vertices[head.faces[own.triangle[row, column].clamp_min(0)]]
    normal = functional.normalize(
        torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dim=-1
    )
    for m, other in enumerate(views):
        if m != n:
            towards = functional.normalize(other.camera.position - points, dim=-1)
            rim[row, column] &= (normal * towards).sum(-1) < SEEN_WELL
    return own.outside | rim


def _stride(chosen: Sequence[Tensor], limit: int) -> int:
    """Pixels between splats, so that fronts and (coarser) backs stay within the limit."""
    stride = 1
    while 1.3 * sum(int(each.sum()) for each in chosen) / stride**2 > limit:
        stride += 1
    return stride


def _carriers(head: HeadModel) -> tuple[Tensor, Tensor]:
    """Triangles that carry hair [A] and those that carry clothes [B]."""
    inner = head.masks["mouth_inner"] + head.masks["eyeballs"] > 0.5
    hairy = ((1 - head.masks["face"]) * ~inner)[head.faces] > 0.5
    own = hairy.all(-1).nonzero()[:, 0]
    if head.bust is not None:
        own = own[own < head.bust.face]
        return own, torch.arange(head.bust.face, len(head.faces))
    middle = head.template[head.faces[own]].mean(1)
    nape = own[(middle[:, 1] + 0.5 * middle[:, 2]).argsort()[:NAPE]]
    return own, nape


def _of_photo(
    head: HeadModel,
    canonical: Tensor,
    carriers: tuple[Tensor, Tensor],
    views: Sequence[PhotoView],
    layers: Sequence[Layers],
    n: int,
    chosen: Tensor,
    stride: int,
) -> list[_Splats]:
    """The splats of photo n: what it shows, and the far side of that."""
    view, own = views[n], layers[n]
    others = [(views[m], layers[m]) for m in range(len(views)) if m != n]
    half = half_thickness(own, float(view.camera.K[0, 0]))
    shift = torch.where(own.distance > 0, agreed_depth(own, half, view, others), BEHIND)
    shift = torch.where(own.rim, -RISE, shift)
    depth = own.depth + shift
    body = (own.distance > 0) & ~own.hair
    if head.bust is None:
        depth = torch.where(body, _body_depth(view, own), depth)
    back = own.depth + half
    result = []
    for far, at, step in ((False, depth, stride), (True, back, 2 * stride)):
        pick = torch.zeros_like(chosen)
        pick[step // 2 :: step, step // 2 :: step] = True
        if far:
            pick &= (own.distance > 0) & own.outside & (half > RISE) & (own.hair if head.bust is None else chosen)
        else:
            pick &= chosen
        result.append(_made(head, canonical, carriers, view, own, pick, at, step, [m for m, _ in others]))
    return result


def _volume(
    head: HeadModel,
    canonical: Tensor,
    carrier: Tensor,
    views: Sequence[PhotoView],
    layers: Sequence[Layers],
    limit: int,
) -> list[_Splats]:
    """Splats inside the hair that several photos agree on."""
    result = []
    for n, (view, own) in enumerate(zip(views, layers, strict=True)):
        pick = torch.zeros_like(own.outside)
        pick[VOLUME_STEP // 2 :: VOLUME_STEP, VOLUME_STEP // 2 :: VOLUME_STEP] = True
        pick &= own.outside & own.hair & (own.distance > 0) & (own.coverage > 0.5)
        others = [(views[m], layers[m]) for m in range(len(views)) if m != n]
        points, colors = agreed_volume(own, pick, view, others)
        middle = own.vertices[head.faces].mean(1)
        triangle = _nearest(carrier, middle, points)
        depth = (points @ view.camera.viewmat[2, :3] + view.camera.viewmat[2, 3])[:, None]
        wide = SPREAD * VOLUME_STEP * depth / view.camera.K[0, 0]
        rotation = view.camera.viewmat[:3, :3].mT
        result.append(
            _Splats(
                means=canonical[head.faces[triangle]].mean(1) + points - middle[triangle],
                quats=matrices_to_quaternions(rotation[None]).expand(len(points), 4).contiguous(),
                scales=torch.cat((wide, wide, torch.full_like(wide, SPREAD * APART)), -1),
                opacities=torch.full((len(points),), VOLUME_OPACITY),
                colors=colors,
                triangle=triangle,
            )
        )
    every = -(-sum(len(part.means) for part in result) // limit)
    if every > 1:
        result = [_Splats(**{f.name: getattr(part, f.name)[::every] for f in fields(part)}) for part in result]
    return result


def _nearest(carrier: Tensor, middle: Tensor, points: Tensor) -> Tensor:
    """Of the triangles `carrier` [A] with their middles in `middle` [F,3], those [M] next to points [M,3]."""
    from scipy.spatial import cKDTree

    return carrier[torch.from_numpy(cKDTree(middle[carrier].numpy()).query(points.numpy())[1])]


def _made(
    head: HeadModel,
    canonical: Tensor,
    carriers: tuple[Tensor, Tensor],
    view: PhotoView,
    own: Layers,
    pick: Tensor,
    depth: Tensor,
    step: int,
    others: Sequence[PhotoView],
) -> _Splats:
    from scipy.spatial import cKDTree

    spread = SPREAD * step
    coarse = slice(step // 2, None, step)
    shown = torch.where(own.outside | own.rim, own.coverage, 0.0)[coarse, coarse]
    dense = opacities(shown, spread, step)
    color = own.color[:, coarse, coarse]
    row, column = torch.nonzero(pick, as_tuple=True)
    cell = row // step, column // step
    points = unprojected(view, depth)[row, column]
    hair = own.hair[row, column]
    opacity = carved(points, dense[cell], hair, others)
    keep = opacity > LEAST_OPACITY
    if head.bust is not None:
        skin = own.vertices[head.masks["face"] > 0.5]
        near = torch.from_numpy(cKDTree(skin.numpy()).query(points.numpy(), distance_upper_bound=CLEAR)[0])
        keep &= hair | near.isinf()
    row, column, points, hair = row[keep], column[keep], points[keep], hair[keep]
    middle = own.vertices[head.faces].mean(1)
    triangle = torch.empty(len(points), dtype=torch.int64)
    for at, carrier in ((hair, carriers[0]), (~hair, carriers[1])):
        triangle[at] = _nearest(carrier, middle, points[at])
    means, quats, scales = unpose_gaussians(
        points,
        *footprints(view, depth, own.outside + 2 * own.rim + 4 * own.hair, row, column, spread),
        canonical,
        own.vertices,
        head.faces,
        triangle,
        torch.full((len(points), 3), 1 / 3),
    )
    opacity = opacity[keep]
    if head.bust is not None:
        opacity = opacity * torch.where(hair, 1.0, fade(above_cut(head.template, canonical, means)))
    solid = opacity > LEAST_OPACITY
    colors = color[:, cell[0], cell[1]].mT[keep]
    return _Splats(*(value[solid] for value in (means, quats, scales, opacity, colors, triangle)))


def _body_depth(view: PhotoView, own: Layers) -> Tensor:
    """Depths [S,S] in metres of a body below a head that has no bust: an ellipse around the neck, falling away."""
    rotation, shift = view.camera.viewmat[:3, :3], view.camera.viewmat[:3, 3]
    neck = torch.tensor(NECK) @ rotation.mT + shift
    size = len(own.depth)
    at = torch.arange(size) + 0.5
    K = view.camera.K
    across = ((at - K[0, 2]) / K[0, 0] * neck[2] - neck[0])[None, :]
    below = ((at - K[1, 2]) / K[1, 1] * neck[2] - neck[1])[:, None]
    depth = neck[2] - CHEST * (1 - (across / SHOULDERS) ** 2).clamp_min(0).sqrt() - SLOPE * (below - 0.03).clamp_min(0)
    share = (own.distance * own.depth / K[0, 0] / 0.03).clamp(0, 1)
    return torch.lerp(own.depth, depth, share)
