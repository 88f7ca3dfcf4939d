"""Weights in bfloat16, arithmetic in whatever precision the device computes fast."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.overrides import TorchFunctionMode

Precision = Literal["float32", "bfloat16"]

_WEIGHTED = (nn.Linear, nn.Conv2d, nn.ConvTranspose2d)


def computes_bfloat16(device: torch.device) -> bool:
    """Whether the device has bfloat16 instructions; without them its bfloat16 products are many times slower."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return device.type == "cpu" and bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())


def halve(module: nn.Module, exempt: Iterable[nn.Module] = ()) -> None:
    """Store the weights of linear layers and convolutions in bfloat16, those inside `exempt` excepted.

    Norms, gains, tokens and buffers stay float32: they are small, and rotary angles and residual sums suffer most.
    """
    spared = {id(inner) for outer in exempt for inner in outer.modules()}
    for layer in module.modules():
        if isinstance(layer, _WEIGHTED) and id(layer) not in spared:
            layer.to(torch.bfloat16)


def arithmetic(precision: Precision, device: torch.device) -> AbstractContextManager[Any]:
    """The context in which a model runs whose weights passed `halve` ("bfloat16") or did not ("float32")."""
    if precision == "float32":
        return nullcontext()
    if computes_bfloat16(device):
        return torch.autocast(device.type, torch.bfloat16)
    return _WidenWeights()


def compile_blocks(blocks: Iterable[nn.Module]) -> None:
    """Compile blocks (`model.transformer.layers`, say) with torch.compile for inputs of any length."""
    for block in blocks:
        block.compile(dynamic=True)


class _WidenWeights(TorchFunctionMode):
    """Layers take their weights in the type of their input: bfloat16 at rest, float32 at work."""

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        if func in (functional.linear, functional.conv2d, functional.conv_transpose2d):
            kind = args[0].dtype
            args = tuple(arg.to(kind) if isinstance(arg, Tensor) else arg for arg in args)
        return func(*args, **(kwargs or {}))
