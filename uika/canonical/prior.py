"""Colours supposed for the parts of a head that no photo shows, continued over the mesh rather than over the atlas.

The atlas cuts the head into charts; colours that were diffused in each chart by itself would meet in visible seams.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from uika.canonical.eyes import complete_eyes
from uika.canonical.hair_color import grain, kinds, like_first, nearby, weighted_median
from uika.canonical.mouth import hidden_mouth
from uika.canonical.regions import EYEBALLS, MOUTH, TEETH, at_texels, mask_at_texels, regions
from uika.canonical.tint import tone
from uika.head import Binding, HeadModel
from uika.head.mesh_parts import tongue

_HAIR_DEPTH = 0.012  # metres that hair stands off the scalp where it surely is hair
_BARE = 0.1  # hairiness up to which the face counts as bare skin
_SOURCE = 30.0  # pull of a fully seen vertex towards its own colour, relative to an edge
_FALLEN = 0.03  # metres below its roots from which hair hangs
_SKIN_PULL, _HAIR_PULL = 0.1, 0.5  # pull of every vertex towards the typical colour of its kind
_SEEN = 0.8  # share of the observation from which a texel lends its strands


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
    everywhere = seen
    for name in ("ears", "eyes"):
        if name in head.masks:
            seen = seen * (1 - mask_at_texels(head, binding, name))
    hair = _hairiness(head, static_offset)
    ears = head.masks["ears"] * (1 - hair) if "ears" in head.masks else torch.zeros_like(hair)
    points = at_texels(head, binding, head.template)
    hairy = at_texels(head, binding, hair[:, None])[:, 0] * (labels == 0)
    skin, strand = kinds(head, binding, points, observed, seen, hairy)
    at_vertices, share = texels_to_vertices(head, binding, observed, seen)
    # Skin between strands and at the hairline lends nothing to hair that no photo shows.
    share = share * (1 - hair * like_first(at_vertices, skin, strand))
    near = nearby(head.template, at_vertices, share * (hair > 0.5), strand)
    kind = torch.lerp(skin.expand_as(near), near, hair[:, None])
    if bool((ears > 0.5).any()):
        on_ear = at_texels(head, binding, ears[:, None])[:, 0] * everywhere * (like_first(observed, skin, strand) > 0.5)
        kind = torch.lerp(kind, weighted_median(observed, on_ear, skin), ears[:, None])
    draw = _SKIN_PULL + (_HAIR_PULL - _SKIN_PULL) * hair
    supposed = _continue(head, at_vertices, share, kind, draw)
    # Hair around an ear lends it nothing.
    result = at_texels(head, binding, torch.lerp(supposed, kind, ears[:, None]))
    strands = (seen > _SEEN) & (hairy > 0.5) & (like_first(observed, skin, strand) < 0.5)
    result = (result + hairy[:, None] * grain(points, observed - result, strands)).clamp(0, 1)
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

    Below the jaw joint it fades to skin, which is reached at the height of the neck joint, unless it hangs.
    """
    hair = (static_offset.norm(dim=-1) / _HAIR_DEPTH).clamp_max(1)
    if "scalp" in head.masks:
        hair = torch.maximum(hair, head.masks["scalp"] * (1 - head.masks.get("ears", 0.0)))
    neck, jaw = head.joints[1:3, 1]
    high = ((head.template[:, 1] - neck) / (jaw - neck)).clamp(0, 1)
    return hair * torch.maximum(high, (-static_offset[:, 1] / _FALLEN).clamp(0, 1))


def _continue(head: HeadModel, color: Tensor, seen: Tensor, kind: Tensor, draw: Tensor) -> Tensor:
    """Harmonic continuation [V,3] of seen vertex colours over the mesh, drawn to `kind` [V,3] by `draw` [V]."""
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.linalg import splu

    count = len(head.template)
    row, column = torch.cat((head.faces[:, [0, 1]], head.faces[:, [1, 2]], head.faces[:, [2, 0]])).numpy().T
    graph = coo_matrix((np.ones(len(row)), (row, column)), shape=(count, count))
    graph = (graph + graph.T).tocsr()
    pull = _SOURCE * (2 * seen - 1).clamp_min(0).double().numpy()[:, None]
    hold = draw.double().numpy()[:, None]
    system = diags(np.asarray(graph.sum(1)).ravel() + pull[:, 0] + hold[:, 0]) - graph
    solved = splu(system.tocsc()).solve(pull * color.double().numpy() + hold * kind.double().numpy())
    return torch.from_numpy(solved).float().clamp(0, 1)
