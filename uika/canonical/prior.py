"""Colours supposed for the parts of a head that no photo shows, continued over the mesh rather than over the atlas.

The atlas cuts the head into charts; colours that were diffused in each chart by itself would meet in visible seams.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from uika.canonical.eyes import complete_eyes
from uika.canonical.mouth import hidden_mouth
from uika.canonical.regions import EYEBALLS, MOUTH, TEETH, at_texels, mask_at_texels, regions
from uika.canonical.tint import tone
from uika.head import Binding, HeadModel
from uika.head.mesh_parts import tongue

_HAIR_DEPTH = 0.012  # metres that hair stands off the scalp where it surely is hair
_BARE = 0.1  # hairiness up to which the face counts as bare skin
_SOURCE = 30.0  # pull of a fully seen vertex towards its own colour, relative to an edge
_KIND_PULL = 0.1  # pull of every vertex towards the typical colour of its kind, skin or hair
_DEFAULT = 0.5  # grey level where nothing of a kind was seen
_SEEN = 0.8  # share of the observation from which a texel lends its strands
_MIN_TEXELS = 500  # fewer say nothing about hair
_EDGE = 0.08  # share of the seen hair that lies beyond the plane of reflection
_RISE = 0.55  # heights below the crown shrink by this much, so that the nape finds hair rather than a face


def prior_colors(
    head: HeadModel, binding: Binding, static_offset: Tensor, color: Tensor, known: Tensor, brightness: float
) -> Tensor:
    """Colours for every texel of the head, to be used where nothing was seen.

    Args:
        head: the head model.
        binding: the M texels of the atlas.
        static_offset: [V,3] metres; tells hair from skin.
        color: [3,S,S] observed colours.
        known: [S,S] share of each texel that was observed well, in [0,1].
        brightness: light in the photos, a factor on the colours of eyeballs and inner mouth.

    Returns:
        [3,S,S], NaN outside the atlas.
    """
    labels = binding.from_map(regions(head, binding)[None])[:, 0]
    observed = binding.from_map(color)
    seen = binding.from_map(known[None])[:, 0] * (labels == 0)
    # Ears are seen between strands of hair, and of the lids of an open eye only shadow and lashes show: these parts
    # take colour but give none.
    for name in ("ears", "eyes"):
        if name in head.masks:
            seen = seen * (1 - mask_at_texels(head, binding, name))
    hair = _hairiness(head, static_offset)
    at_vertices, share = texels_to_vertices(head, binding, observed, seen)
    face = head.masks["face"] if "face" in head.masks else 1 - hair
    skin = _typical(at_vertices, share * face * (hair < _BARE))
    strand = _typical_hair(at_vertices, share * (hair > 0.5), skin)
    vertices = _continue(head, at_vertices, share, torch.lerp(skin, strand, hair[:, None]))
    result = at_texels(head, binding, vertices)
    points = at_texels(head, binding, head.template)
    hairy = at_texels(head, binding, hair[:, None])[:, 0] * (labels == 0)
    # Skin between strands lends nothing to the side that no photo shows.
    like_hair = (observed - strand).norm(dim=-1) <= (observed - skin).norm(dim=-1)
    result = (result + reflected_hair_detail(points, observed, result, seen * like_hair, hairy)).clamp(0, 1)
    # No skin may appear where lids and lips open.
    known_share = binding.from_map(known[None])[:, 0]
    shown = tone(observed, known_share, (labels == 0) & (hairy < _BARE))
    if "eyeballs" in head.masks:
        ball = labels == EYEBALLS
        eyes = complete_eyes(head, points, ball, observed, known_share, brightness, shown)
        result[ball] = eyes[ball]
    if "mouth_inner" in head.masks:
        inner = labels >= MOUTH
        on_tongue = at_texels(head, binding, tongue(head)[:, None].float())[:, 0] > 0.5
        mouth = hidden_mouth(head, points, inner, on_tongue, labels == TEETH)
        result[inner] = shown.apply(brightness * mouth[inner])
    return binding.to_map(result, fill=torch.nan)


def texels_to_vertices(head: HeadModel, binding: Binding, color: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Mean colour [V,3] of the texels around each vertex, and how well it was seen [V] in [0,1]."""
    corners = head.faces[binding.triangle].flatten()
    reach = binding.barycentric.flatten()
    weight = (binding.barycentric * seen[:, None]).flatten()
    count = len(head.template)
    total = torch.zeros(count).index_add(0, corners, reach)
    sums = torch.zeros(count).index_add(0, corners, weight)
    colors = torch.zeros(count, 3).index_add(0, corners, weight[:, None] * color.repeat_interleave(3, 0))
    return colors / sums.clamp_min(1e-9)[:, None], sums / total.clamp_min(1e-9)


def _hairiness(head: HeadModel, static_offset: Tensor) -> Tensor:
    """How far each vertex [V] belongs to hair rather than skin, in [0,1]: the scalp and where hair stands off it.

    Below the jaw joint it fades to skin, which is reached at the height of the neck joint.
    """
    hair = (static_offset.norm(dim=-1) / _HAIR_DEPTH).clamp_max(1)
    if "scalp" in head.masks:
        hair = torch.maximum(hair, head.masks["scalp"])
    neck, jaw = head.joints[1:3, 1]
    return hair * ((head.template[:, 1] - neck) / (jaw - neck)).clamp(0, 1)


def _continue(head: HeadModel, color: Tensor, seen: Tensor, kind: Tensor) -> Tensor:
    """Harmonic continuation [V,3] of vertex colours over the mesh from where they were seen, drawn to `kind` [V,3]."""
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.linalg import splu

    count = len(head.template)
    row, column = torch.cat((head.faces[:, [0, 1]], head.faces[:, [1, 2]], head.faces[:, [2, 0]])).numpy().T
    graph = coo_matrix((np.ones(len(row)), (row, column)), shape=(count, count))
    graph = (graph + graph.T).tocsr()
    pull = _SOURCE * (2 * seen - 1).clamp_min(0).double().numpy()[:, None]
    system = diags(np.asarray(graph.sum(1)).ravel() + pull[:, 0] + _KIND_PULL) - graph
    solved = splu(system.tocsc()).solve(pull * color.double().numpy() + _KIND_PULL * kind.double().numpy())
    return torch.from_numpy(solved).float().clamp(0, 1)


def _typical(color: Tensor, seen: Tensor) -> Tensor:
    """Median [3] of the colours that were seen well; grey when there are none."""
    chosen = color[seen > 0.5]
    return chosen.median(0).values if len(chosen) else torch.full((3,), _DEFAULT)


def _typical_hair(color: Tensor, seen: Tensor, skin: Tensor) -> Tensor:
    """Median [3] of the half of the colours seen well that is less like skin [3]; grey when there are none.

    Where hair should be, photos show forehead, ears and neck too, if the fit is a little off or the hair is thin.
    """
    chosen = color[seen > 0.5]
    if not len(chosen):
        return torch.full((3,), _DEFAULT)
    distance = (chosen - skin).norm(dim=-1)
    return chosen[distance >= distance.median()].median(0).values


def reflected_hair_detail(points: Tensor, color: Tensor, smooth: Tensor, seen: Tensor, hair: Tensor) -> Tensor:
    """What to add to smooth hair colours so that they look like the hair that was seen.

    Args:
        points: [M,3] texels on the head, metres, Y up.
        color: [M,3] observed colours.
        smooth: [M,3] the smooth continuation of those colours.
        seen: [M] share of each texel that was observed, in [0,1].
        hair: [M] how far each texel belongs to hair, in [0,1].

    Returns:
        Detail [M,3], 0 on skin and where too little hair was seen.
    """
    from scipy.spatial import cKDTree

    source = (seen > _SEEN) & (hair > 0.5)
    detail = torch.zeros_like(smooth)
    if int(source.sum()) < _MIN_TEXELS:
        return detail
    target = ~source & (hair > 0)
    level = torch.tensor([1.0, 0.0, 1.0])
    towards = torch.nn.functional.normalize((points[source].mean(0) - points[hair > 0.5].mean(0)) * level, dim=0)
    plane = torch.quantile(points[source] @ towards, _EDGE)
    wanted = points[target]
    along = wanted @ towards
    wanted = wanted + ((plane + (plane - along).abs()) - along)[:, None] * towards
    crown = points[source, 1].max()
    wanted[:, 1] = crown - _RISE * (crown - wanted[:, 1]).clamp_min(0)
    place = torch.nonzero(source).flatten()
    nearest = place[torch.from_numpy(cKDTree(points[source].numpy()).query(wanted.numpy(), workers=-1)[1])]
    detail[target] = hair[target, None] * (color[nearest] - smooth[nearest])
    return detail
