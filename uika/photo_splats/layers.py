"""Which pixels of a photo the rendered surface does not explain, and how opaque splats there must be."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from uika.avatar import Avatar
from uika.avatar.rendering import render
from uika.head import Camera, HeadModel, HeadParameters, pose_vertices, project, rasterize

SOLID = 0.6  # rendered coverage from which a pixel counts as surface
RIM = 7  # pixels inside the outline, where the surface is seen too flat to have got its colours
LEAST = 0.12  # coverage that is worth a splat: mattes leave a haze of background
THIN = 0.97  # rendered coverage below which what lies behind shines through
SKIN_REACH = 4  # pixels around the face's own skin
SPREAD = 0.6  # standard deviation of a splat in pixels
BLUR = 0.3  # variance in square pixels that the rasterizer adds to every splat
MOST = 0.95  # opacity of a splat
ROUNDS = 3  # of solving for opacities
MOST_GAIN = 1.6  # between the light of two photos
CLOTH = 0.3  # matte of the person beyond that of head and hair from which a pixel shows clothes


@dataclass(frozen=True, eq=False)
class PhotoView:
    """A photo with the head fitted to it; S pixels on each side."""

    parameters: HeadParameters
    camera: Camera
    image: Tensor  # [3,S,S] sRGB in [0,1], the person on white
    matte: Tensor  # [S,S] of the person, in [0,1]
    hair: Tensor  # [S,S] of head and hair, in [0,1]


@dataclass(frozen=True, eq=False)
class Layers:
    """What a photo [S,S] lacks in the rendered surface."""

    vertices: Tensor  # [V,3] the posed mesh, metres
    outside: Tensor  # bool, the person beyond the surface and behind its thin edge
    rim: Tensor  # bool, hair on the surface just inside its outline
    hair: Tensor  # bool, of those pixels: hair or other parts of the head; the others show clothes
    coverage: Tensor  # in [0,1], that new splats should give
    color: Tensor  # [3,S,S] of the person without background
    depth: Tensor  # metres, of the surface, continued outwards from its outline
    distance: Tensor  # pixels to the surface's outline, 0 inside
    triangle: Tensor  # int64, in front, -1 for none


def missing(avatar: Avatar, head: HeadModel, view: PhotoView, *, clothes: bool, relit: bool = False) -> Layers:
    """Compare a photo with the avatar rendered at its camera.

    Args:
        avatar: the surface as splats.
        head: its head model.
        view: the photo.
        clothes: whether the photo may tell what lies below the head.
        relit: whether the avatar's colours are not kept under this photo's own light.
    """
    from scipy.ndimage import distance_transform_edt, label

    shown = render(avatar, view.parameters, view.camera, head, depth=True)
    assert shown.depth is not None
    vertices = pose_vertices(head, view.parameters.replace(identity=avatar.identity), avatar.static_offset)
    pixels, depth = project(vertices, view.camera)
    size = view.camera.height
    triangle, mix = rasterize(pixels, head.faces, size, size, depth=depth)

    solid = shown.alpha > SOLID
    away, nearest = distance_transform_edt(~solid.numpy(), return_indices=True)
    row, column = torch.from_numpy(nearest).long()
    hair = _head_parts(view)
    away = torch.from_numpy(away).float()
    if head.bust is not None and bool((worn := solid & (triangle >= head.bust.face)).any()):
        # Hair that lies on the shoulders stays there when the head turns.
        hair &= ~worn[row, column] | solid
        # A collar beside the jaw lies where the shoulders do, not where the jaw does.
        far, below = distance_transform_edt(~worn.numpy(), return_indices=True)
        row, column = (
            torch.where(hair | solid, a, torch.from_numpy(b)) for a, b in zip((row, column), below, strict=True)
        )
        away = torch.where(hair | solid, away, torch.from_numpy(far).float())
    within = torch.from_numpy(distance_transform_edt(functional.pad(solid, (1, 1, 1, 1)).numpy()))[1:-1, 1:-1]
    mean = _box(torch.where(solid, shown.depth, 0.0)) / _box(solid.float()).clamp_min(1e-6)

    face = (head.masks["face"][head.faces[triangle.clamp_min(0)]] * mix).sum(-1) * (triangle >= 0)
    skin = functional.max_pool2d(face[None, None], 2 * SKIN_REACH + 1, 1, SKIN_REACH)[0, 0] > 0.5
    wanted = view.matte if clothes else view.hair
    lacking = ((wanted - shown.alpha) / (1 - shown.alpha).clamp_min(1e-3)).clamp(0, 1)
    # What the matte adds at the face's own outline is background light or an error of the fit.
    outside = (shown.alpha < THIN) & (lacking > LEAST) & ~(skin[row, column] & (hair | solid))
    # What hangs together with nothing would float when seen from the side.
    parts = torch.from_numpy(label((outside | solid).numpy())[0])
    outside &= torch.isin(parts, parts[solid].unique())
    rim = solid & (within <= RIM) & (wanted > 0.5) & ~skin & hair
    alpha = view.matte.clamp_min(0.05)
    color = ((view.image - (1 - alpha)) / alpha).clamp(0, 1)
    if relit:
        color = _under_light(color, shown.rgb.permute(2, 0, 1), solid & (within > RIM) & (view.hair > 0.95))
    return Layers(
        vertices=vertices,
        outside=outside,
        rim=rim,
        hair=hair,
        coverage=torch.where(rim, wanted, torch.where(outside, lacking, 0.0)),
        color=color,
        depth=mean[row, column],
        distance=away,
        triangle=triangle,
    )


def _head_parts(view: PhotoView) -> Tensor:
    """Pixels [S,S] that show parts of the head rather than clothes; thin ones as their nearest solid one."""
    from scipy.ndimage import distance_transform_edt

    solid = view.matte > 0.5
    hair = view.matte - view.hair < CLOTH
    if not bool(solid.any()):
        return hair
    row, column = torch.from_numpy(distance_transform_edt(~solid.numpy(), return_distances=False, return_indices=True))
    return hair[row.long(), column.long()]


def opacities(coverage: Tensor, spread: float, stride: int) -> Tensor:
    """Opacities [H,W] of splats on a grid that together cover as `coverage` [H,W] says.

    Optical depths add up: splats overlap, and one alone at a thin strand must be denser than one among others.

    Args:
        coverage: wanted, in [0,1].
        spread: standard deviation of a splat in pixels.
        stride: pixels between splats.
    """
    wanted = -torch.log1p(-coverage.clamp(0, 1 - 1e-3))
    kernel = _kernel(spread, stride)
    found = wanted / kernel.sum()
    for _ in range(ROUNDS):
        found = found * wanted / _filtered(found, kernel).clamp_min(1e-6)
    return found.clamp(0, MOST)


def _under_light(color: Tensor, shown: Tensor, common: Tensor) -> Tensor:
    """Colours [3,S,S] times the factors that make a photo as bright as its avatar where both show the head."""
    if not bool(common.any()):
        return color
    one, other = color[:, common], shown[:, common]
    gain = (one * other).sum(1) / one.square().sum(1).clamp_min(1e-6)
    return (color * gain.clamp(1 / MOST_GAIN, MOST_GAIN)[:, None, None]).clamp(0, 1)


def _kernel(spread: float, stride: int) -> Tensor:
    """Weights of the splats around one, at its centre."""
    reach = 2 if stride == 1 else 3
    at = stride * torch.arange(-reach, reach + 1).float()
    line = torch.exp(-0.5 * at.square() / (spread**2 + BLUR))
    return line[:, None] * line


def _filtered(values: Tensor, kernel: Tensor) -> Tensor:
    return functional.conv2d(values[None, None], kernel[None, None], padding=len(kernel) // 2)[0, 0]


def _box(values: Tensor) -> Tensor:
    return functional.avg_pool2d(values[None, None], 9, 1, 4, count_include_pad=False)[0, 0]
