"""All that one head of one step consists of."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from uika.head import HeadParameters


@dataclass(frozen=True, eq=False)
class Item:
    """One head with V photos and D pictures of S*S pixels; M Gaussians, N vertices. Everything float32."""

    keys: tuple[str, ...]  # of the images it was made from
    notes: tuple[str, ...]  # what could not be read and was replaced, or is not used; mostly empty
    images: Tensor  # [V,3,S,S] photos on one colour
    masks: Tensor  # [V,1,S,S]
    uv: Tensor  # [V,2,S,S], NaN where unknown
    weights: Tensor  # [V,1,S,S]
    labels: Tensor  # [V,2,S,S] exact correspondences, NaN where unknown
    points: Tensor  # [M,3] surface; empty for the estimator, as all below
    quats: Tensor  # [M,4]
    scales: Tensor  # [M,3]
    prior: Tensor  # [3,A,A] supposed colours of the atlas
    lift: Tensor  # [1,A,A] metres of hair over the bald head
    shape: Tensor  # [3,A,A] metres off the mean head
    canonical: Tensor  # [N,3] vertices
    posed: Tensor  # [D,N,3] vertices
    viewmats: Tensor  # [D,4,4]
    Ks: Tensor  # [D,3,3]
    pictures: Tensor  # [D,3,S,S] on the colours of `backgrounds`
    coverage: Tensor  # [D,1,S,S] of the person, or of the splats of the true surface (`TrainConfig.outline`)
    person: Tensor  # [D,1,S,S] the person's masks
    backgrounds: Tensor  # [D,3]
    texture: Tensor  # [4,A,A] true colours of the atlas and where they are known; empty if nowhere
    relief: Tensor  # [M,3] where the true surface lies, in the frame of `points`
    driving: HeadParameters | None = None  # [D] of the pictures with the mean identity, for models on the template

    def to(self, device: torch.device) -> Item:
        """A copy on another device."""
        moved: dict[str, Any] = {name: v.to(device) for name, v in vars(self).items() if isinstance(v, Tensor)}
        return replace(self, **moved, driving=None if self.driving is None else self.driving.to(device=device))
