"""The third result of a call: what became of the splats, worked out when somebody looks."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from . import _values
from ._backend import exclusive
from ._call import Call
from ._core import Trace
from ._intersections import intersections
from ._project import CULLED

_MISSING: Any = object()
_LISTED = ("tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets")
Maker = Callable[["Meta"], Any]


class Meta(dict[str, Any]):
    """A dict whose values are worked out at first access; pickles and deep copies hold detached tensors."""

    def __init__(self, makers: Mapping[str, Maker]) -> None:
        """Values by name, as functions that make them from the rest."""
        super().__init__(dict.fromkeys(makers))
        self._makers = dict(makers)

    @exclusive
    def __getitem__(self, key: str) -> Any:
        """The value of `key`."""
        maker = self._makers.get(key)
        if maker is not None:
            self[key] = maker(self)
        return super().__getitem__(key)

    def __setitem__(self, key: str, value: Any) -> None:
        """Set a value of one's own."""
        self._makers.pop(key, None)
        super().__setitem__(key, value)

    def __delitem__(self, key: str) -> None:
        """Forget a value."""
        self._makers.pop(key, None)
        super().__delitem__(key)

    def __iter__(self) -> Iterator[str]:
        """All keys. That this method exists makes `dict(meta)` and `{**meta}` ask for each value."""
        return super().__iter__()

    def get(self, key: str, default: Any = None) -> Any:
        """The value of `key`, or `default`."""
        return self[key] if key in self else default  # noqa: SIM401

    def pop(self, key: str, default: Any = _MISSING) -> Any:
        """Remove and return the value of `key`."""
        if key not in self and default is not _MISSING:
            return default
        value = self[key]
        del self[key]
        return value

    def popitem(self) -> tuple[str, Any]:
        """Remove and return the last item."""
        key = list(self)[-1]
        return key, self.pop(key)

    def setdefault(self, key: str, default: Any = None) -> Any:
        """The value of `key`, which becomes `default` where there is none."""
        if key not in self:
            self[key] = default
        return self[key]

    def update(self, *others: Any, **values: Any) -> None:
        """Set several values."""
        for key, value in dict(*others, **values).items():
            self[key] = value

    def copy(self) -> dict[str, Any]:
        """A plain dict of all values."""
        return {key: self[key] for key in self}

    def items(self) -> Any:
        """All keys and values."""
        return self.copy().items()

    def values(self) -> Any:
        """All values."""
        return self.copy().values()

    def __or__(self, other: Any) -> Any:
        """A plain dict of both."""
        return self.copy() | dict(other)

    def __ror__(self, other: Any) -> Any:
        """A plain dict of both."""
        return dict(other) | self.copy()

    def __repr__(self) -> str:
        """As a dict's."""
        return repr(self.copy())

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Pickle as a dict of a type that `torch.load` reads without further ado."""
        values = ((key, v.detach() if isinstance(v, Tensor) else v) for key, v in self.copy().items())
        return OrderedDict, (), None, None, values


def describe(
    call: Call, n: int, device: torch.device, between: tuple[Tensor, ...] | None = None, tile_size: int = 16
) -> Meta:
    """Meta of one call over all its images; `between` are the nodes' results in between, filled here on demand."""
    settings, traces = call.settings, call.traces

    def result(index: int, name: str) -> Maker:
        def make(_: Meta) -> Tensor:
            values = _values.values(call, name, n, device)
            if between is None:
                return values
            between[index].data.copy_(values)
            call.looked.add(name)
            return between[index]

        return make

    def each(size: int, dtype: torch.dtype, read: Callable[[Any], Tensor], pack: bool = True) -> Maker:
        def make(_: Meta) -> Tensor:
            empty = torch.zeros(n * size, dtype=dtype, device=device)
            parts = [empty if t.projected is None else read(t.projected) for t in traces]
            full = torch.stack([part.view(n, size) for part in parts])
            if not pack:
                return full.view(*call.batch, call.cameras, n)
            return _values.packed(call, full, size).reshape(_values.shape_of(call, n, size))

        return make

    def culled(trace: Trace) -> dict[str, int]:
        reasons = {reason: 0 for reason in CULLED if reason} if trace.projected is None else trace.projected.culled
        return reasons | trace.skipped()

    grid = _values.tile_grid(call, tile_size)

    def listed(index: int) -> Maker:
        def make(meta: Meta) -> Tensor:
            if call.packed:
                batch, camera, _ = _values.ids(call, n)
                images = batch * call.cameras + camera
            else:
                images = torch.arange(call.count, device=device).repeat_interleave(n)
            rows = [_values.values(call, name, n, device) for name in ("means2d", "depths")]
            radii = meta["radii"].reshape(-1, 2)
            shape = rows[1].shape
            found = list(
                intersections(rows[0].reshape(-1, 2), radii, rows[1].reshape(-1), images, call.count, tile_size, grid)
            )
            found[0] = found[0].view(shape)
            found[3] = found[3].view(*call.batch, call.cameras, *found[3].shape[1:])
            meta.update(zip(_LISTED, found, strict=True))
            return found[index]

        return make

    def row(index: int) -> Maker:
        return lambda _: _values.ids(call, n)[index] if call.packed else None

    return Meta(
        {
            "batch_ids": row(0),
            "camera_ids": row(1),
            "gaussian_ids": row(2),
            "radii": each(2, torch.int32, lambda p: p.radii.torch()),
            **{name: result(index, name) for index, name in enumerate(_values.BETWEEN)},
            "opacities": each(1, torch.float32, lambda p: p.opacities.torch()),
            "tile_width": lambda _: grid[0],
            "tile_height": lambda _: grid[1],
            **{name: listed(index) for index, name in enumerate(_LISTED)},
            "width": lambda _: settings.width,
            "height": lambda _: settings.height,
            "tile_size": lambda _: tile_size,
            "n_batches": lambda _: call.batches,
            "n_cameras": lambda _: call.cameras,
            "visible": each(1, torch.bool, lambda p: p.visible.torch(), pack=False),
            "n_visible": lambda _: [_values.visible_count(t, n) for t in traces],
            "n_pairs": lambda _: [0 if t.projected is None else t.projected.pairs for t in traces],
            "n_culled": lambda _: [culled(t) for t in traces],
        }
    )
