"""Displace the scalp until the head's silhouette meets the matte, so that hair has a surface to live on.

The built-in head is bald. Vertices off the face move along their normals, smoothly and by at most the paper's 0.1 m
(supplement, Table S1: offset range), in rounds: outline vertices learn how far the matte reaches beyond them, a
membrane spreads that over the scalp.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from uika.fitting.long_hair import hanging_hair, overlap
from uika.head import Camera, HeadModel, HeadParameters, pose_vertices, project, vertex_normals

MAX_OFFSET, MIN_OFFSET = 0.1, -0.02  # metres; hair pressed flat may lie inside the average skull
ROUNDS = 8
ANGLES = 180  # directions around the head in which the outline is compared
OUTLINE_SHARE = 0.985  # vertices this close to the outline, relative to its radius, belong to it
RADII = 192
EDGE = 3.0  # pixels from the photo's edge at which it cuts an outline
BENDING, TENSION = 10.0, 0.05  # smoothness of the offset field against the outline's pull
REST_PULL = 1e-3  # towards the skull
BACK_PULL = 2e-2  # of what no outline shows towards the hair's thickness at the sides
MAX_USUAL = 0.05  # metres, of usual hair
TEMPLES, CROWN = 0.02, 0.09  # metres between which it is looked at
NAPE = -0.09  # metres, where it ends
HIDDEN, UNTRUSTED = -0.2, 0.1  # cosine of the viewing angle of what is hidden; trust of photos that do not count
FACE_PULL = 0.1  # keeps vertices at the hairline near the skin
EAR_BARE, EAR_COVERED = 0.005, 0.012  # metres of hair below which an ear shows as it is, above which not at all
EAR_RINGS, EAR_ROUNDS = 3, 80
FALLEN = 0.03  # metres below its roots from which hair follows its neighbours and not the outline, which it ends
HANGING_LOSS = 0.015  # overlap of one matte and silhouette that hair may lose by hanging and still be taken to hang
TURN_POWER = 16  # of the cosine of a face's turn: half the trust at 17 degrees, a tenth at 30
NORMAL_ROUNDS = 30  # of averaging, so that an ear moves out as one piece


@dataclass(frozen=True)
class _Region:
    vertices: Tensor  # [R] vertex ids that may move
    smoothness: Any  # [R,R] sparse quadratic form of the membrane
    share: Tensor  # [R] in [0,1], how freely each may move
    lowest: Tensor  # [R] metres, how far each may move inward
    sides: Tensor  # bool [R], at the height of the temples, where no bun or quiff stands
    full: Tensor  # [R] share of the usual thickness, less towards the nape


def fit_hair(
    head: HeadModel, parameters: HeadParameters, cameras: Camera, mattes: Tensor, bounds: Tensor | None = None
) -> Tensor:
    """Offset [V,3] in metres that makes the silhouette meet the matte in every photo: at most 0.1 m along the normals.

    Hair that hangs beside the neck is let down first (`uika.fitting.long_hair`).

    Args:
        head: the head model.
        parameters: [N] fitted parameters, one identity, joints at rest.
        cameras: [N] fitted cameras.
        mattes: [N,S,S] head and hair without shoulders, in [0,1].
        bounds: [N,4] left, top, right and lower edge of each photo in pixels of its crop: hair that reaches them goes
            on beyond; None where a crop shows nothing but photo.
    """
    edges = _edges(head)
    region = _region(head, edges)
    centres = _centres(head, parameters, cameras)
    size = float(mattes.shape[-1])
    whole_crop = torch.tensor([0.0, 0.0, size, size]).expand(len(mattes), 4)
    bounds = whole_crop if bounds is None else torch.cat((bounds[:, :2].clamp_min(0), bounds[:, 2:].clamp_max(size)), 1)
    outlines = [_reach(matte, at[0], edge) for matte, at, edge in zip(mattes, centres, bounds, strict=True)]
    reach, least = (torch.stack(part) for part in zip(*outlines, strict=True))
    trust = _trust(cameras)
    canonical = pose_vertices(head, parameters[0].replace(expression=torch.zeros_like(parameters[0].expression)))
    normals = _smooth_normals(vertex_normals(canonical, head.faces), edges)
    bald = pose_vertices(head, parameters)
    towards = torch.nn.functional.normalize(cameras.position[:, None] - bald, dim=-1)
    turned = (normals * towards).sum(-1) < HIDDEN

    def lift(flat: Tensor, trust: Tensor) -> Tensor:
        hidden = (turned | (trust < UNTRUSTED)[:, None]).all(0) & (flat == 0).all(-1)
        still = flat[:, 1] < -FALLEN
        height = torch.zeros(len(head.template))
        for _ in range(ROUNDS):
            # The cameras carry the pose, so the offset simply adds to the posed head.
            vertices = bald + flat + height[:, None] * normals
            wanted, pull = _outline_demand(head, vertices, cameras, centres, (reach, least), trust, region)
            pull = pull * ~still[region.vertices]
            height = _membrane(region, height, wanted, pull, hidden)
        return height

    def whole(hanging: Tensor, trust: Tensor) -> Tensor:
        height = lift(hanging, trust)
        flat = _covered_ears(head, canonical, height, edges, bool((hanging != 0).any()))
        if bool((flat != 0).any()):
            height = lift(hanging + flat, trust)
        offset = flat + height[:, None] * normals
        return hanging + offset * (MAX_OFFSET / offset.norm(dim=-1, keepdim=True).clamp(min=MAX_OFFSET))

    stands, hangs = torch.zeros_like(canonical), hanging_hair(head, bald, cameras, mattes)
    if not bool((hangs != 0).any()):
        return whole(stands, trust)
    # Hair that only stands off far misses more than that when it is let down; standing hair can imitate any outline,
    # but hardly those of several photos at once. Every photo has a say in this.
    stood, fell = (whole(start, torch.ones_like(trust)) for start in (stands, hangs))
    standing, fallen = (overlap(head, bald + offset, cameras, mattes) for offset in (stood, fell))
    down = fallen > standing - HANGING_LOSS / len(bald) ** 2
    if len(bald) == 1:
        return fell if down else stood
    return whole(hangs if down else stands, trust)


def _trust(cameras: Camera) -> Tensor:
    """How far each photo [N] is believed, at most 1: the more a face is turned, the worse its camera is known."""
    facing = (1 - cameras.viewmat[:, 2, :2].square().sum(-1)).clamp(min=1e-6)
    return (facing / facing.max()) ** (TURN_POWER / 2)


def _covered_ears(head: HeadModel, canonical: Tensor, height: Tensor, edges: Tensor, hanging: bool) -> Tensor:
    """Offset [V,3] that flattens an ear over which hair lies: its relief must not show through."""
    ears = _filled(head.masks["ears"], edges)
    start, end = edges.T
    # The mask is hollow in the folds too: close it, then leave out what belongs to the face and the neck.
    for reduction in ("amax",) * EAR_RINGS + ("amin",) * (EAR_RINGS - 1):
        ears = ears.scatter_reduce(0, start, ears[end], reduction)
    ears = ears * (1 - head.masks["face"]) * (1 - head.masks["neck"])
    degree = torch.zeros_like(ears).index_add(0, start, torch.ones_like(ears[end]))[:, None].clamp(min=1)
    smooth = canonical
    for _ in range(EAR_ROUNDS):
        mean = torch.zeros_like(smooth).index_add(0, start, smooth[end]) / degree
        smooth = torch.lerp(smooth, mean, ears[:, None])
    share = torch.zeros_like(ears)
    for side in (head.template[:, 0] > 0, head.template[:, 0] <= 0):
        weight = head.masks["ears"] * side
        lifted = (weight * height).sum() / weight.sum().clamp(min=1e-6)
        covered = torch.ones(()) if hanging else ((lifted - EAR_BARE) / (EAR_COVERED - EAR_BARE)).clamp(0, 1)
        share = torch.where(side, covered, share)
    return share[:, None] * (smooth - canonical)


def _filled(mask: Tensor, edges: Tensor) -> Tensor:
    """The mask [V] with the hollows that it encloses, such as the ears' bowls."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    outside = mask < 0.5
    free = edges[outside[edges].all(-1)].numpy()
    graph = coo_matrix((np.ones(len(free)), free.T), shape=(len(mask),) * 2)
    label = torch.from_numpy(connected_components(graph)[1])
    start, end = edges.T
    bordering = torch.isin(label, label[start[outside[start] & ~outside[end]]])
    return torch.where(outside & bordering & (label != label[outside].mode().values), 1.0, mask)


def _edges(head: HeadModel) -> Tensor:
    """Directed edges [D,2] of the mesh, both ways."""
    corners = head.faces
    edges = torch.cat((corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]))
    return torch.cat((edges, edges.flip(1))).unique(dim=0)


def _smooth_normals(normals: Tensor, edges: Tensor) -> Tensor:
    for _ in range(NORMAL_ROUNDS):
        normals = normals.index_add(0, edges[:, 0], normals[edges[:, 1]])
        normals = torch.nn.functional.normalize(normals, dim=-1)
    return normals


def _region(head: HeadModel, edges: Tensor) -> _Region:
    """Vertices off the face, with the bending energy of the offset field over the mesh."""
    from scipy import sparse

    inner = head.masks["mouth_inner"] + head.masks["eyeballs"]
    front_neck = head.masks["neck"] * (head.template[:, 2] > 0.0)
    share = (1.0 - head.masks["face"] - front_neck).clamp(0, 1) * (inner < 0.5)
    vertices = torch.nonzero(share > 0.02).flatten()
    R = len(vertices)
    place = torch.full((len(share),), -1)
    place[vertices] = torch.arange(R)
    length = (head.template[edges[:, 0]] - head.template[edges[:, 1]]).norm(dim=-1).clamp(min=1e-4)
    inside = place[edges[:, 0]] >= 0
    start, end = place[edges[inside, 0]].numpy(), place[edges[inside, 1]].numpy()
    weight = (1.0 / length[inside]).double().numpy()
    degree = np.bincount(start, weight, R)
    both = end >= 0
    # A neighbour on the face counts in the degree only: it holds the field at zero, hair starts at the skin.
    adjacency = sparse.csr_matrix((weight[both], (start[both], end[both])), shape=(R, R))
    laplacian = sparse.identity(R) - sparse.diags(1.0 / degree) @ adjacency
    smoothness = BENDING * laplacian.T @ laplacian + 0.5 * TENSION * (laplacian + laplacian.T)
    # Mattes of heads end at the jaw: that they show no neck does not mean that there is none.
    lowest = MIN_OFFSET * (1 - head.masks["neck"].clamp(0, 1))
    height = head.template[vertices, 1]
    sides = (height > TEMPLES) & (height < CROWN)
    full = ((height - NAPE) / (TEMPLES - NAPE)).clamp(0, 1)
    return _Region(vertices, smoothness, share[vertices], lowest[vertices], sides, full)


def _centres(head: HeadModel, parameters: HeadParameters, cameras: Camera) -> Tensor:
    """Pixels [N,1,2] of a point inside each posed skull from which the hair's outline is seen in every direction."""
    scalp = head.masks["scalp"]
    middle = (pose_vertices(head, parameters) * scalp[:, None]).sum(-2, keepdim=True) / scalp.sum()
    return project(middle, cameras)[0]


def _reach(matte: Tensor, centre: Tensor, bounds: Tensor) -> tuple[Tensor, Tensor]:
    """Radius [ANGLES] in pixels of the matte's outline around `centre`, NaN where it leaves the photo; and at least."""
    S = matte.shape[0]
    angle = (torch.arange(ANGLES) + 0.5) * (2 * torch.pi / ANGLES)
    radius = torch.linspace(0.0, 0.75 * S, RADII * 2)
    along = torch.stack((angle.cos(), angle.sin()), -1)
    points = centre + radius[:, None, None] * along
    grid = points / S * 2 - 1
    value = torch.nn.functional.grid_sample(matte[None, None], grid[None], align_corners=False)[0, 0]
    inside = value > 0.5
    last = torch.where(inside, radius[:, None], torch.zeros(())).amax(0)
    edge = centre + last[:, None] * along
    cut = ((edge < bounds[:2] + EDGE) | (edge > bounds[2:] - EDGE)).any(-1) | ~inside.any(0)
    return torch.where(cut, torch.nan, last), last


def _outline_demand(
    head: HeadModel,
    vertices: Tensor,
    cameras: Camera,
    centres: Tensor,
    outline_radii: tuple[Tensor, Tensor],
    trust: Tensor,
    region: _Region,
) -> tuple[Tensor, Tensor]:
    """How far each region vertex should move along its normal [R] in metres, and how strongly [R], over all photos."""
    pixels, depth = project(vertices, cameras)
    normals = torch.nn.functional.normalize(vertex_normals(vertices, head.faces), dim=-1)
    turn = cameras.viewmat[..., :3, :3]
    normals = normals @ turn.mT
    ray = pixels - centres
    radius = ray.norm(dim=-1).clamp(min=1e-6)
    sector = (torch.atan2(ray[..., 1], ray[..., 0]) % (2 * torch.pi) / (2 * torch.pi) * ANGLES).long() % ANGLES
    skin = head.masks["mouth_inner"] + head.masks["eyeballs"] < 0.5
    outline = torch.zeros(len(pixels), ANGLES).scatter_reduce(1, sector, radius * skin, "amax")
    spread = torch.nn.functional.max_pool1d(torch.cat((outline[:, -1:], outline, outline[:, :1]), 1)[:, None], 3, 1)[
        :, 0
    ]
    reach, least = (each.gather(1, sector) - radius for each in outline_radii)
    # Hair that the photo's edge cuts reaches at least so far.
    gap = torch.where(reach.isnan() & (least > 0), least, reach)
    outward = (normals[..., :2] * ray / radius[..., None]).sum(-1)
    at = (radius > OUTLINE_SHARE * spread.gather(1, sector)) & (outward > 0.3) & gap.isfinite()
    metres = gap.nan_to_num() * depth / cameras.K[..., 0, 0][:, None] / outward.clamp(min=0.5)
    weight = at * trust[:, None]
    total = weight.sum(0).clamp(min=1e-9)
    wanted = (weight * metres).sum(0) / total
    return wanted[region.vertices], weight.sum(0)[region.vertices] * region.share


def _membrane(region: _Region, height: Tensor, wanted: Tensor, pull: Tensor, hidden: Tensor) -> Tensor:
    """Heights [V] after one round: outline vertices reach for their target, the rest follows smoothly."""
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    weight = pull.double().numpy()
    target = (height[region.vertices] + wanted).clamp(max=MAX_OFFSET).maximum(region.lowest).double().numpy()
    stiff = FACE_PULL * (1.0 / region.share.double().clamp(min=0.02).numpy() - 1.0)
    # What no outline shows would go on rising behind: it is drawn to the thickness of the hair at the sides.
    aside = (pull > UNTRUSTED) & region.sides
    usual = float((height[region.vertices] + wanted)[aside].clamp(0, MAX_USUAL).median()) if bool(aside.any()) else 0.0
    back = (BACK_PULL * hidden[region.vertices] * region.share).double().numpy()
    system = (region.smoothness + sparse.diags(weight + back + REST_PULL + stiff)).tocsc()
    solved = spsolve(system, weight * target + back * usual * region.full.double().numpy())
    out = torch.zeros_like(height)
    out[region.vertices] = torch.from_numpy(solved).float().clamp(max=MAX_OFFSET).maximum(region.lowest)
    return out
