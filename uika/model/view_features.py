"""What one photo contributes: computed once, kept, joined with that of other photos (paper sections 3.1, 3.2)."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from uika.uv import Sums

Keep = Literal["all", "foreground"]


class ViewFeatures(NamedTuple):
    """One photo as the transformer and the decoder read it."""

    screen: Tensor  # [L,D] tokens of its patches
    uv: Tensor | None  # [M,D] tokens of its reprojected image; None without UV attention
    sums: Sums  # what it adds to the aggregate: [3,S,S], [1,S,S], [1,S,S] float64
    patches: int  # patches of both images, of which L + M are kept


# Share of its area up to which a patch counts as empty: what little it shows, its neighbours tell as well.
EMPTY = 1 / 8


def occupied(maps: Tensor, grid: tuple[int, int], share: float = 0.0) -> Tensor:
    """Which cells [N,h*w] of a grid (h, w) are filled to more than `share` by maps [N,1,H,W] of values in [0,1]."""
    return (functional.adaptive_avg_pool2d(maps.float(), grid) > share).flatten(1)


def covered_tokens(texel: Tensor, map_size: int, grid: int) -> Tensor:
    """Which UV tokens [grid^2] have one of the texels [M] of a `map_size` atlas in their cell."""
    valid = torch.zeros(map_size * map_size, device=texel.device)
    valid[texel] = 1
    return occupied(valid.view(1, 1, map_size, map_size), (grid, grid))[0]


class FeatureCache:
    """Features of photos seen before, found again by their content; serves one model whose weights do not change.

    The least recently used go first. For use without gradients.
    """

    def __init__(self, capacity: int = 64) -> None:
        """`capacity`: number of photos kept; at the paper's size one takes about 20 MB.

        Raises ValueError below 1.
        """
        if capacity < 1:
            raise ValueError(f"capacity must be at least 1 photo, got {capacity}")
        self.capacity = capacity
        self.hits = 0
        self.misses = 0
        self._entries: dict[str, OrderedDict[bytes, Any]] = {}

    def resolve(self, kind: str, keys: Sequence[bytes], compute: Callable[[list[int]], Sequence[Any]]) -> list[Any]:
        """The value of each key, from before or from `compute(indices of the missing ones)`."""
        entries = self._entries.setdefault(kind, OrderedDict())
        first = {key: index for index, key in reversed(list(enumerate(keys)))}
        missing = sorted(index for key, index in first.items() if key not in entries)
        self.misses += len(missing)
        self.hits += len(keys) - len(missing)
        found = {key: entries[key] for key in first if key in entries}
        if missing:
            found.update((keys[index], value) for index, value in zip(missing, compute(missing), strict=True))
        for key in keys:
            entries[key] = found[key]
            entries.move_to_end(key)
        while len(entries) > self.capacity:
            entries.popitem(last=False)
        return [found[key] for key in keys]


def content_keys(tensors: Sequence[Tensor | None], *words: object) -> list[bytes]:
    """A digest per row of tensors [N,...] (None has no part in it), different for different `words`."""
    count = next(len(tensor) for tensor in tensors if tensor is not None)
    keys = []
    for index in range(count):
        digest = hashlib.blake2b(repr(words).encode(), digest_size=16)
        for tensor in tensors:
            if tensor is not None:
                row = tensor[index].detach().cpu().contiguous()
                digest.update(f"{row.dtype}{list(row.shape)}".encode())
                digest.update(row.view(torch.uint8).numpy().data if row.numel() else b"")
        keys.append(digest.digest())
    return keys
