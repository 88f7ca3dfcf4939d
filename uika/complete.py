"""Colours supposed for the parts of a head that no photo shows, continued over the mesh rather than over the atlas.

The atlas cuts the head into charts; colours that were diffused in each chart by itself would meet in visible seams.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from uika.head import Binding, HeadModel
from uika.strands import strands

# sRGB colours under even light of parts that lids and lips hide: no skin may appear there when they open.
_HIDDEN = {"eyeballs": (0.75, 0.71, 0.69), "mouth_inner": (0.36, 0.15, 0.14), "teeth": (0.80, 0.77, 0.71)}
_REGIONS = ("eyeballs", "mouth_inner", "teeth")  # labelled 1, 2, 3; skin and hair are 0
MOUTH = 2
_HAIR_DEPTH = 0.012  # metres that hair stands off the scalp where it surely is hair
_BARE = 0.1  # hairiness up to which the face counts as bare skin
_SOURCE = 30.0  # pull of a fully seen vertex towards its own colour, relative to an edge
_KIND_PULL = 0.1  # pull of every vertex towards the typical colour of its kind, skin or hair
_DEFAULT = 0.5  # grey level where nothing of a kind was seen


def regions(head: HeadModel, binding: Binding) -> Tensor:
    """Labels [S,S] of the parts whose colours do not mix: 0 skin and hair, 1 eyeballs, 2 inner mouth, 3 teeth."""
    labels = torch.zeros(len(binding), 1, dtype=torch.int64)
    for index, name in enumerate(_REGIONS):
        if name in head.masks:
            labels[_share(head, binding, name) > 0.5] = index + 1
    return binding.to_map(labels)[0]


def suppose(
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
            seen = seen * (1 - _share(head, binding, name))
    hair = _hairiness(head, static_offset)
    vertices = _continue(head, *_to_vertices(head, binding, observed, seen), hair)
    result = _mixed(head, binding, vertices)
    points = _mixed(head, binding, head.template)
    hairy = _mixed(head, binding, hair[:, None])[:, 0] * (labels == 0)
    result = (result + strands(points, observed, result, seen, hairy)).clamp(0, 1)
    for index, name in enumerate(_REGIONS):
        result[labels == index + 1] = brightness * torch.tensor(_HIDDEN[name])
    return binding.to_map(result, fill=torch.nan)


def _mixed(head: HeadModel, binding: Binding, values: Tensor) -> Tensor:
    """Vertex values [V,C] at the texels [M,C]."""
    return (values[head.faces[binding.triangle]] * binding.barycentric[..., None]).sum(1)


def _share(head: HeadModel, binding: Binding, name: str) -> Tensor:
    return _mixed(head, binding, head.masks[name][:, None])[:, 0]


def _to_vertices(head: HeadModel, binding: Binding, color: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
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


def _continue(head: HeadModel, color: Tensor, seen: Tensor, hair: Tensor) -> Tensor:
    """Harmonic continuation [V,3] of vertex colours over the mesh from where they were seen, drawn to their kind."""
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.linalg import splu

    count = len(head.template)
    row, column = torch.cat((head.faces[:, [0, 1]], head.faces[:, [1, 2]], head.faces[:, [2, 0]])).numpy().T
    graph = coo_matrix((np.ones(len(row)), (row, column)), shape=(count, count))
    graph = (graph + graph.T).tocsr()
    face = head.masks["face"] if "face" in head.masks else 1 - hair
    skin = _typical(color, seen * face * (hair < _BARE))
    kind = torch.lerp(skin, _typical(color, seen * (hair > 0.5)), hair[:, None]).double().numpy()
    pull = _SOURCE * (2 * seen - 1).clamp_min(0).double().numpy()[:, None]
    system = diags(np.asarray(graph.sum(1)).ravel() + pull[:, 0] + _KIND_PULL) - graph
    solved = splu(system.tocsc()).solve(pull * color.double().numpy() + _KIND_PULL * kind)
    return torch.from_numpy(solved).float().clamp(0, 1)


def _typical(color: Tensor, seen: Tensor) -> Tensor:
    """Median [3] of the colours that were seen well; grey when there are none."""
    chosen = color[seen > 0.5]
    return chosen.median(0).values if len(chosen) else torch.full((3,), _DEFAULT)
