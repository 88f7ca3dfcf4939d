"""Skin and clothes of a bust where no photo shows them: each goes on as itself, with a collar's edge between."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from uika.canonical.prior import texels_to_vertices
from uika.canonical.regions import at_texels
from uika.head import Binding, HeadModel

SOURCE = 30.0  # pull of a seen vertex towards its own colour over that of an edge towards a neighbour's
FAINT = 1e-6  # of what nothing reaches
SEEN = 0.3  # share of what lies around a vertex, doubled, from which it is
SHADE = (0.7, 1.2)  # brightness of a neck's skin over that of the neck's rim
LIKE_SKIN, UNLIKE_SKIN = 0.07, 0.13  # sRGB distance from skin so shaded up to which, and from which, it is none
EDGE = (0.66, 0.74)  # share of skin between which clothes end


@dataclass(frozen=True, eq=False)
class Continued:
    """Colours of skin and clothes [V,3] at each vertex and the share of skin [V] there."""

    skin: Tensor
    cloth: Tensor
    bare: Tensor

    def colors(self, head: HeadModel, binding: Binding) -> Tensor:
        """Colours [M,3] at texels."""
        bare = at_texels(head, binding, self.bare[:, None])
        share = ((bare - EDGE[0]) / (EDGE[1] - EDGE[0])).clamp(0, 1)
        return torch.lerp(at_texels(head, binding, self.cloth), at_texels(head, binding, self.skin), share)


def continued(
    head: HeadModel, binding: Binding, observed: Tensor, known: Tensor, neck: tuple[Binding, Tensor]
) -> Continued:
    """Harmonic continuations over the bust of what photos show of it; skin goes on from the head's at the rim too.

    Args:
        head: a head model with a bust.
        binding: its M texels.
        observed: [M,3] sRGB where seen.
        known: [M] in [0,1], how well that is.
        neck: texels of the head and their colours [P,3].
    """
    assert head.bust is not None
    first = head.bust.vertex
    head_colors, told = texels_to_vertices(head, *neck, torch.ones(len(neck[0])))
    touched = head.faces[head.bust.face :].unique()
    rim = touched[touched < first]
    typical = head_colors[rim[told[rim] > 0]].median(0).values
    head_colors = torch.where(told[:, None] > 0, head_colors, typical)[:first]
    # Told apart before they are averaged: a vertex at a collar's edge has both.
    likeness = _skinlike(observed, typical)

    def at_vertices(share: Tensor) -> tuple[Tensor, Tensor]:
        color, seen = texels_to_vertices(head, binding, observed, known * share)
        return color[first:], seen[first:]

    (skin, on_skin), (cloth, on_cloth) = at_vertices(likeness), at_vertices(1 - likeness)
    graph = _Graph(head)
    both = on_skin + on_cloth
    bare = graph.continued((on_skin / both.clamp_min(1e-6))[:, None], (2 * both - 1).clamp_min(0), torch.ones(first, 1))
    skin = graph.continued(skin, _sure(on_skin), head_colors)
    if bool((_sure(on_cloth) > 0).any()):
        cloth = graph.continued(cloth, _sure(on_cloth), None)
    else:
        cloth, bare = skin, torch.ones_like(bare)
    parts = torch.cat((skin, cloth, bare), 1)
    whole = torch.cat((torch.cat((head_colors, head_colors, torch.ones(first, 1)), 1), parts))
    return Continued(whole[:, :3], whole[:, 3:6], whole[:, 6])


def _sure(seen: Tensor) -> Tensor:
    """How far a vertex of which a share was seen is trusted."""
    return (2 * seen - SEEN).clamp(0, 1)


def _skinlike(color: Tensor, skin: Tensor) -> Tensor:
    """How like skin [3], shaded or lit, colours [B,3] are, in [0,1]."""
    shade = ((color * skin).sum(-1) / skin.square().sum().clamp_min(1e-6)).clamp(*SHADE)
    distance = (color - shade[:, None] * skin).norm(dim=-1)
    return ((UNLIKE_SKIN - distance) / (UNLIKE_SKIN - LIKE_SKIN)).clamp(0, 1)


class _Graph:
    """The bust's vertices and those of the head at its rim, joined by edges."""

    def __init__(self, head: HeadModel) -> None:
        from scipy.sparse import coo_matrix

        assert head.bust is not None
        self.first, count = head.bust.vertex, len(head.template)
        corners = head.faces[head.bust.face :]
        row, column = torch.cat((corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]])).numpy().T
        graph: Any = coo_matrix((np.ones(len(row)), (row, column)), shape=(count, count))
        rows = (graph + graph.T).tocsr()[self.first :]
        self.inner, self.held = rows[:, self.first :], rows[:, : self.first]

    def continued(self, values: Tensor, trust: Tensor, held: Tensor | None) -> Tensor:
        """Values [B,C] near those given as far as they are trusted [B], going on from those `held` [H,C] at the rim."""
        from scipy.sparse import diags
        from scipy.sparse.linalg import splu

        pull = SOURCE * trust.double().numpy()[:, None]
        degree = np.asarray(self.inner.sum(1)).ravel()
        right = pull * values.double().numpy()
        if held is not None:
            degree = degree + np.asarray(self.held.sum(1)).ravel()
            right = right + self.held @ held.double().numpy()
        system = diags(degree + pull[:, 0] + FAINT) - self.inner
        return torch.from_numpy(splu(system.tocsc()).solve(right)).float()
