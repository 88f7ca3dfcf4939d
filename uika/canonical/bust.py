"""The bust as splats: the photos' own colours where they show it, their continuation over the mesh elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d, normalize

from uika.canonical.prior import texels_to_vertices
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

SIZE = 256  # texels along the side of the bust's tile
OPACITY = 0.95
FADE = (0.004, 0.03)  # metres above the cut between which the bust becomes opaque
GRAZING, FACING = 0.1, 0.5  # cosines between which a photo's colour gains weight
SURE_MATTE, FULL_MATTE, EDGE = 0.7, 0.98, 2  # matte between which it does, and pixels inside its edge left out
BEHIND = 0.006  # metres behind the nearest surface from which a texel counts as hidden
SOURCE, KIND = 30.0, 0.3  # pull of a seen vertex towards its own colour, of all towards their kind, over an edge's
LOWER = 0.03  # metres by which collars are higher behind than in front
KIN = 24  # seen vertices that say what an unseen one is made of


@dataclass(frozen=True, eq=False)
class BustSplats:
    """M splats on the bust; tensors as those of `uika.avatar.Avatar`."""

    means: Tensor  # [M,3] metres
    quats: Tensor  # [M,4] wxyz
    scales: Tensor  # [M,3] metres
    opacities: Tensor  # [M]
    colors: Tensor  # [M,3] sRGB
    binding: Binding


@dataclass(frozen=True, eq=False)
class BustView:
    """A photo with the whole mesh posed in it."""

    vertices: Tensor  # [V,3] metres
    camera: Camera
    image: Tensor  # [3,S,S] sRGB
    matte: Tensor  # [S,S] in [0,1]


def bust_splats(
    head: HeadModel,
    identity: Tensor,
    offset: Tensor,
    views: Sequence[BustView],
    neck: tuple[Binding, Tensor],
) -> BustSplats:
    """Splats for the bust of one person.

    Args:
        head: a head model with a bust.
        identity: [K] standard deviations.
        offset: [V,3] metres, of the fitted torso.
        views: N photos.
        neck: texels of the head and their colours [P,3]: unseen skin of the bust goes on from those at its rim.
    """
    binding = uv_texels(head, SIZE, tile=1)
    neutral = HeadParameters.zeros(head).replace(identity=identity)
    means, quats, scales = closing_splats(head, shaped_vertices(head, neutral, offset), binding)
    total, weight = torch.zeros(len(binding), 3), torch.zeros(len(binding), 1)
    for view in views:
        color, trust = _seen(head, binding, view)
        total, weight = total + trust[:, None] * color, weight + trust[:, None]
    observed, known = total / weight.clamp_min(1e-6), weight.clamp_max(1)
    colors = torch.lerp(_continued(head, binding, observed, known[:, 0], neck), observed, known)
    height = surface_points(head.template, head.faces, binding)[:, 1] - head.template[:, 1].min()
    return BustSplats(means, quats, scales, OPACITY * _ramp(height, *FADE), colors.clamp(0, 1), binding)


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
    color = grid_sample(view.image[None], grid, padding_mode="border", align_corners=False)[0, :, 0].mT
    return color, trust


def _continued(
    head: HeadModel, binding: Binding, observed: Tensor, known: Tensor, neck: tuple[Binding, Tensor]
) -> Tensor:
    """Harmonic continuation [M,3] of the seen colours over the bust, which begins with the head's at the rim.

    Each vertex is drawn to the colours seen before or behind it: a shirt that is red in front is red at the back.
    """
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.linalg import splu

    assert head.bust is not None
    own, seen = texels_to_vertices(head, binding, observed, known)
    rim, _ = texels_to_vertices(head, *neck, torch.ones(len(neck[0])))
    first, count = head.bust.vertex, len(head.template)
    corners = head.faces[head.bust.face :]
    row, column = torch.cat((corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]])).numpy().T
    graph = coo_matrix((np.ones(len(row)), (row, column)), shape=(count, count))
    graph = (graph + graph.T).tocsr()
    pull = SOURCE * (2 * seen[first:] - 1).clamp_min(0).double().numpy()[:, None]
    kind = _kind(head.template[first:], own[first:], seen[first:])
    draw = 0.0 if kind is None else KIND
    inner, held = graph[first:, first:], graph[first:, :first]
    system = diags(np.asarray(graph[first:].sum(1)).ravel() + pull[:, 0] + draw) - inner
    right = pull * own[first:].double().numpy() + held @ rim[:first].double().numpy()
    if kind is not None:
        right = right + draw * kind.double().numpy()
    solved = torch.from_numpy(splu(system.tocsc()).solve(right)).float()
    return at_texels(head, binding, torch.cat((rim[:first], solved)))


def _kind(points: Tensor, color: Tensor, seen: Tensor) -> Tensor | None:
    """Colours [B,3] seen where a frontal view, mirrored too, shows the vertices [B,3] a little lower; None if none."""
    from scipy.spatial import cKDTree

    sure = seen > 0.8
    if int(sure.sum()) < KIN:
        return None
    flat = points[:, :2]
    places = torch.cat((flat[sure], flat[sure] * torch.tensor([-1.0, 1.0])))
    near = cKDTree(places.numpy()).query((flat - torch.tensor([0.0, LOWER])).numpy(), KIN)[1]
    return color[sure].repeat(2, 1)[torch.from_numpy(near)].median(1).values


def _ramp(value: Tensor, low: float, high: float) -> Tensor:
    return ((value - low) / (high - low)).clamp(0, 1)
