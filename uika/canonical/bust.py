"""The bust as splats: the photos' own colours where they show it, their continuation over the mesh elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d, normalize

from uika.canonical.clothes import continued
from uika.canonical.regions import at_texels
from uika.canonical.surface import closing_splats
from uika.head import (
    Binding,
    Camera,
    HeadModel,
    HeadParameters,
    project,
    rasterize,
    shaped_vertices,
    surface_points,
    uv_texels,
    vertex_normals,
)
from uika.head.bust import fade

SIZE = 256  # texels along the side of the bust's tile where no photo shows it; twice as many elsewhere
OPACITY = 0.95
GRAZING, FACING = 0.03, 0.15  # cosines between which a photo's colour gains weight
SHOWN = 0.2  # trust from which a texel counts as seen
MOST_GAIN = 1.6  # between the light of two photos
SURE_MATTE, FULL_MATTE, EDGE = 0.7, 0.98, 2  # matte between which it does, and pixels inside its edge left out
OUTLINE = (0.3, 0.7)  # matte between which splats are kept
BEHIND = 0.006  # metres behind the nearest surface from which a texel counts as hidden


@dataclass(frozen=True, eq=False)
class BustSplats:
    """M splats on the bust; tensors as those of `uika.avatar.Avatar`."""

    means: Tensor  # [M,3] metres
    quats: Tensor  # [M,4] wxyz
    scales: Tensor  # [M,3] metres
    opacities: Tensor  # [M]
    colors: Tensor  # [M,3] sRGB
    triangle: Tensor  # [M] int64
    barycentric: Tensor  # [M,3]


@dataclass(frozen=True, eq=False)
class BustView:
    """A photo with the whole mesh posed in it."""

    vertices: Tensor  # [V,3] metres
    camera: Camera
    image: Tensor  # [3,S,S] sRGB, the person on white
    matte: Tensor  # [S,S] in [0,1]
    inside: Tensor  # [S,S] how far each pixel lies in the photo


def bust_splats(
    head: HeadModel,
    identity: Tensor,
    offset: Tensor,
    views: Sequence[BustView],
    neck: tuple[Binding, Tensor],
) -> BustSplats:
    """Splats for the bust of one person.

    Clothes move and fold between photos: what the first view shows is taken from it alone, and so on.

    Args:
        head: a head model with a bust.
        identity: [K] standard deviations.
        offset: [V,3] metres, of the fitted torso.
        views: N photos, the most telling first.
        neck: texels of the head and their colours [P,3]: unseen skin of the bust goes on from those at its rim.
    """
    coarse, fine = (uv_texels(head, size, tile=1) for size in (SIZE, 2 * SIZE))
    neutral = HeadParameters.zeros(head).replace(identity=identity)
    vertices = shaped_vertices(head, neutral, offset)
    observed, known = torch.zeros(len(fine), 3), torch.zeros(len(fine), 1)
    for view in views:
        color, trust = _seen(head, fine, view)
        if len(views) > 1:
            color = color * _gain(head, neck, view)
        share = torch.minimum(trust[:, None], 1 - known)
        observed, known = observed + share * color, known + share
    observed = observed / known.clamp_min(1e-6)
    unseen = continued(head, fine, observed, known[:, 0], neck)
    shown = torch.nn.functional.max_pool2d(fine.to_map(known), 2)[0] > SHOWN
    parts = []
    for binding, step in ((coarse, 1), (fine, 2)):
        row, column = torch.div(binding.texel, binding.size, rounding_mode="floor"), binding.texel % binding.size
        kept = shown[row // step, column // step] == (step == 2)
        means, quats, scales = (value[kept] for value in closing_splats(head, vertices, binding))
        colors = unseen.colors(head, binding)[kept]
        if step == 2:
            colors = torch.lerp(colors, observed[kept], known[kept])
        height = surface_points(head.template, head.faces, binding)[kept, 1] - head.template[:, 1].min()
        within = _within(views[0], surface_points(views[0].vertices, head.faces, binding)[kept])
        parts.append(
            (
                means,
                quats,
                scales,
                OPACITY * fade(height) * within,
                colors.clamp(0, 1),
                binding.triangle[kept],
                binding.barycentric[kept],
            )
        )
    return BustSplats(*(torch.cat(part) for part in zip(*parts, strict=True)))


def _gain(head: HeadModel, neck: tuple[Binding, Tensor], view: BustView) -> Tensor:
    """Factors [3] that bring a photo under the light that the head's colours are kept under."""
    color, trust = _seen(head, neck[0], view)
    one = (trust[:, None] * color * neck[1]).sum(0)
    return (one / (trust[:, None] * color.square()).sum(0).clamp_min(1e-6)).clamp(1 / MOST_GAIN, MOST_GAIN)


def _within(view: BustView, points: Tensor) -> Tensor:
    """How far points [M,3] lie inside the person's outline [M] in [0,1]; 1 where the photo does not tell."""
    told = -max_pool2d(-view.inside[None, None], 3, 1, 1)
    size = view.camera.width
    grid = (2 * project(points, view.camera)[0] / size - 1)[None, None]
    share, tells = grid_sample(torch.cat((view.matte[None, None], told), 1), grid, align_corners=False)[0, :, 0]
    return torch.where(tells > 0.99, _ramp(share, *OUTLINE), 1.0)


def _seen(head: HeadModel, binding: Binding, view: BustView) -> tuple[Tensor, Tensor]:
    """Colours [M,3] of the texels in a photo and the trust in them [M] in [0,1], 0 where it does not show them."""
    camera = view.camera
    pixels, depth = project(view.vertices, camera)
    triangle, mix = rasterize(pixels, head.faces, camera.height, camera.width, depth=depth)
    front = torch.where(triangle >= 0, (depth[head.faces[triangle.clamp_min(0)]] * mix).sum(-1), torch.inf)
    points = surface_points(view.vertices, head.faces, binding)
    normals = normalize(at_texels(head, binding, vertex_normals(view.vertices, head.faces)), dim=-1)
    cosine = (normals * normalize(camera.position - points, dim=-1)).sum(-1)
    places, distance = project(points, camera)
    size = places.new_tensor([camera.width, camera.height])
    inside = ((places > 0) & (places < size)).all(-1)
    column, row = places.long().clamp_min(0).minimum(size.long() - 1).unbind(-1)
    visible = inside & (distance < front[row, column] + BEHIND)
    inner = -max_pool2d(-view.matte[None, None], 2 * EDGE + 1, 1, EDGE)[0, 0]
    trust = _ramp(inner[row, column], SURE_MATTE, FULL_MATTE) * _ramp(cosine, GRAZING, FACING) * visible
    grid = (2 * places / size - 1)[None, None]
    alpha = view.matte.clamp_min(SURE_MATTE / 2)
    person = ((view.image - (1 - alpha)) / alpha).clamp(0, 1)
    color = grid_sample(person[None], grid, padding_mode="border", align_corners=False)[0, :, 0].mT
    return color, trust


def _ramp(value: Tensor, low: float, high: float) -> Tensor:
    return ((value - low) / (high - low)).clamp(0, 1)
