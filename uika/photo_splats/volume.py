"""How deep what lies outside the surface is: one photo tells only its outline, several agree or do not.

Hair that hangs over a forehead is as wide as the forehead. A photo from the side shows how far it stands off, but not
how wide it is; photos from the front say where there is hair in front of the skin.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from uika.head import project
from uika.photo_splats.layers import Layers, PhotoView

DEEPEST = 0.03  # metres that anything is taken to stand before or behind the plane of the outline
CANDIDATES = 9  # depths tried
WINDOW = 7  # pixels over which photos are compared
COLOR_SPREAD = 0.12  # sRGB; light differs between photos
DECISIVE = 0.15  # score by which the best depth must beat the one supposed
REACH, APART = 0.08, 0.01  # metres before and behind the outline that are searched for hair, and between its splats
AGREED = 0.5  # likeness from which a photo confirms hair
HIDDEN = 0.01  # metres behind another photo's surface from which a point is not seen there


def half_thickness(layers: Layers, focal: float) -> Tensor:
    """Metres [S,S] by which what a pixel shows rises before the plane of the nearest outline, as a round body would.

    A body that sticks out as far as T is taken to be as deep as it is wide: a half circle of radius T.
    """
    from scipy.ndimage import distance_transform_edt

    unit = layers.depth / focal
    solid = layers.outside | (layers.distance == 0)
    further = torch.from_numpy(distance_transform_edt(functional.pad(solid, (1, 1, 1, 1)).numpy()))[1:-1, 1:-1].float()
    reach = layers.distance + further
    return ((reach**2 - layers.distance**2).clamp_min(0).sqrt() * unit).clamp_max(DEEPEST)


def agreed_depth(layers: Layers, half: Tensor, view: PhotoView, others: Sequence[tuple[PhotoView, Layers]]) -> Tensor:
    """Metres [S,S] to add to a photo's depth so that what it shows outside agrees with the other photos.

    Depths in a range around the surface's outline are swept; where no depth is clearly better than the round body's
    front, that is kept.
    """
    front = -half
    if not others:
        return front
    size = len(half)
    span = torch.linspace(-1.5, 1.0, CANDIDATES) * DEEPEST
    rays = _rays(view, size)
    scores = []
    for shift in (*span, front):
        points = _world(view, rays * (layers.depth + shift)[..., None])
        total, count = torch.zeros(size, size), torch.zeros(size, size)
        for other, surface in others:
            score, known, _ = _likeness(layers.color, points, other, surface)
            total, count = total + score * known, count + known
        mean = _box(total * layers.outside) / _box(count * layers.outside).clamp_min(1e-6)
        scores.append(torch.where(_box(count * layers.outside) > 0, mean, 0.0))
    supposed = scores.pop()
    best, index = torch.stack(scores).max(0)
    return torch.where(best > supposed + DECISIVE, span[index], front)


def agreed_volume(
    layers: Layers, pick: Tensor, view: PhotoView, others: Sequence[tuple[PhotoView, Layers]]
) -> tuple[Tensor, Tensor]:
    """What several photos agree to be hair along the rays of a photo's pixels.

    Args:
        layers: of the photo.
        pick: [S,S] pixels, P of them True.
        view: the photo.
        others: the other photos with their layers.

    Returns:
        Points [M,3] in space that no photo contradicts and at least one confirms, and their colours [M,3], which are
        those of the most frontal photo that shows them.
    """
    row, column = torch.nonzero(pick, as_tuple=True)
    steps = torch.arange(-REACH, REACH + APART / 2, APART)
    depth = layers.depth[row, column][:, None] + steps
    points = _world(view, _rays(view, len(pick))[row, column][:, None] * depth[..., None])
    own = layers.color[:, row, column][..., None]
    color, facing = own.expand(3, *depth.shape), torch.full_like(depth, -float(view.camera.viewmat[2, 2]))
    confirmed, denied = torch.zeros_like(depth, dtype=torch.bool), torch.zeros_like(depth, dtype=torch.bool)
    for other, surface in others:
        score, known, seen = _likeness(own, points, other, surface)
        alike = (known > 0) & (score > AGREED)
        confirmed |= alike
        denied |= (known > 0) & ~alike
        towards = -float(other.camera.viewmat[2, 2])
        color = torch.where(alike & (facing < towards), seen, color)
        facing = torch.where(alike, facing.clamp_min(towards), facing)
    agreed = confirmed & ~denied
    return points[agreed], color.permute(1, 2, 0)[agreed]


def carved(points: Tensor, opacity: Tensor, hair: Tensor, others: Sequence[PhotoView]) -> Tensor:
    """Opacities [M] of points [M,3] less what other photos show as background there.

    Args:
        points: metres.
        opacity: of each.
        hair: bool [M], whether a point belongs to the head; clothes may have moved between photos.
        others: the other photos.
    """
    for other in others:
        pixels, depth = project(points, other.camera)
        grid = 2 * pixels / other.camera.width - 1
        inside = (grid.abs() < 0.98).all(-1) & (depth > 0) & hair
        matte = functional.max_pool2d(other.matte[None, None], 5, 1, 2)
        shown = functional.grid_sample(matte, grid[None, None], align_corners=False, padding_mode="border")[0, 0, 0]
        opacity = torch.where(inside, opacity * shown, opacity)
    return opacity


def _likeness(color: Tensor, points: Tensor, other: PhotoView, surface: Layers) -> tuple[Tensor, Tensor, Tensor]:
    """How well points [H,W,3] fit another photo [H,W] in [0,1], whether it can tell [H,W], and its colours [3,H,W]."""
    pixels, depth = project(points.flatten(0, 1), other.camera)
    grid = (2 * pixels / other.camera.width - 1).view(1, *points.shape[:2], 2)
    maps = torch.cat((surface.color, other.matte[None], surface.depth[None], (surface.triangle >= 0).float()[None]))
    seen = functional.grid_sample(maps[None], grid, align_corners=False, padding_mode="border")[0]
    inside = (grid[0].abs() < 0.98).all(-1)
    hidden = (seen[5] > 0.5) & (depth.view_as(seen[4]) > seen[4] + HIDDEN)
    like = torch.exp(-(((color - seen[:3]) / COLOR_SPREAD) ** 2).mean(0))
    return like * seen[3], (inside & ~hidden).float(), seen[:3]


def _rays(view: PhotoView, size: int) -> Tensor:
    """Directions [S,S,3] of the pixels in the camera's axes, of depth 1."""
    at = torch.arange(size) + 0.5
    row, column = torch.meshgrid(at, at, indexing="ij")
    K = view.camera.K
    return torch.stack(((column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1], torch.ones(size, size)), -1)


def _world(view: PhotoView, points: Tensor) -> Tensor:
    """Points [...,3] in the camera's axes -> in space."""
    rotation, shift = view.camera.viewmat[:3, :3], view.camera.viewmat[:3, 3]
    return (points - shift) @ rotation


def unprojected(view: PhotoView, depth: Tensor) -> Tensor:
    """Points in space [S,S,3] of pixels at depths [S,S] in metres."""
    return _world(view, _rays(view, len(depth)) * depth[..., None])


def _box(values: Tensor) -> Tensor:
    return functional.avg_pool2d(values[None, None], WINDOW, 1, WINDOW // 2)[0, 0]
