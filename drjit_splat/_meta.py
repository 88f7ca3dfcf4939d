"""The third result of a call: what became of the splats, worked out when somebody looks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from ._backend import exclusive
from ._core import Trace
from ._project import CULLED, RECORD


class Meta(Mapping[str, Any]):
    """Mapping whose values are computed on first access."""

    def __init__(self, makers: Mapping[str, Callable[[], Any]]) -> None:
        self._makers = makers
        self._known: dict[str, Any] = {}

    @exclusive
    def __getitem__(self, key: str) -> Any:
        """The value of `key`."""
        if key not in self._known:
            self._known[key] = self._makers[key]()
        return self._known[key]

    def __iter__(self) -> Iterator[str]:
        """Names of all values."""
        return iter(self._makers)

    def __len__(self) -> int:
        """Number of values."""
        return len(self._makers)


def stack(parts: list[Tensor]) -> Tensor:
    """Images of all cameras in one tensor, without a copy when there is one camera."""
    return parts[0][None] if len(parts) == 1 else torch.stack(parts)


def _conics(geometry: Tensor) -> Tensor:
    half = 0.5 * math.log2(math.e)
    a, h, d = (geometry[:, k] / half for k in (2, 3, 4))
    h = geometry[:, 3]
    return torch.stack([a, a * h, a * h * h + d], -1)


def describe(traces: list[Trace], n: int, device: torch.device) -> Meta:
    """Meta of one call over all its cameras."""
    settings = traces[0].settings

    def each(shape: tuple[int, ...], dtype: torch.dtype, read: Callable[[Any], Tensor]) -> Callable[[], Tensor]:
        def make() -> Tensor:
            empty = torch.zeros(n, *shape, dtype=dtype, device=device)
            return stack([empty if t.projected is None else read(t.projected) for t in traces])

        return make

    def geometry(p: Any) -> Tensor:
        records: Tensor = p.records.torch().view(n, RECORD)
        return records

    middle = torch.tensor([0.5 * settings.width, 0.5 * settings.height], device=device)

    def culled(trace: Trace) -> dict[str, int]:
        reasons = {reason: 0 for reason in CULLED if reason} if trace.projected is None else trace.projected.culled
        return reasons | trace.skipped()

    def visible(trace: Trace) -> int:
        return 0 if trace.projected is None else n - sum(trace.projected.culled.values())

    real = torch.float32
    return Meta(
        {
            "means2d": each((2,), real, lambda p: geometry(p)[:, :2] + middle),
            "depths": each((), real, lambda p: p.depths.torch()),
            "conics": each((3,), real, lambda p: _conics(geometry(p))),
            "opacities": each((), real, lambda p: p.opacities.torch()),
            "radii": each((2,), torch.int32, lambda p: p.radii.torch().view(n, 2)),
            "visible": each((), torch.bool, lambda p: p.visible.torch()),
            "n_visible": lambda: [visible(t) for t in traces],
            "n_pairs": lambda: [0 if t.projected is None else t.projected.pairs for t in traces],
            "n_culled": lambda: [culled(t) for t in traces],
            "n_cameras": lambda: len(traces),
            "width": lambda: settings.width,
            "height": lambda: settings.height,
        }
    )
