"""Learnable UV tokens through a stack of dual attention blocks (paper section 3.2, figure 2b)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from uika.model.config import ModelConfig
from uika.model.mm_block import Contexts, MMBlock

_NORM_EPS = 1e-6
_POSITION_BASE = 10000.0


def sincos_positions(grid: int, dim: int) -> Tensor:
    """[grid*grid, dim] in row-major order; first half of the channels from the column, second from the row."""
    quarter = dim // 4
    frequencies = _POSITION_BASE ** (-torch.arange(quarter, dtype=torch.float64) / quarter)
    angles = torch.arange(grid, dtype=torch.float64)[:, None] * frequencies
    line = torch.cat([angles.sin(), angles.cos()], dim=1)
    columns = line[None].expand(grid, grid, -1)
    rows = line[:, None].expand(grid, grid, -1)
    return torch.cat([columns, rows], dim=-1).reshape(grid * grid, dim).float()


class ContextMemory:
    """The contexts of earlier photos as each block read them; they stay as they were then."""

    def __init__(self) -> None:
        """Nothing yet."""
        self._layers: dict[int, Contexts] = {}

    def exchange(self, layer: int, contexts: Contexts) -> Contexts | None:
        """What the block of this number read before, which from now on includes `contexts`."""
        before = self._layers.get(layer)
        if before is None:
            self._layers[layer] = contexts
        else:
            uv = None if before[1] is None or contexts[1] is None else torch.cat([before[1], contexts[1]], dim=1)
            self._layers[layer] = (torch.cat([before[0], contexts[0]], dim=1), uv)
        return before


class MMTransformer(nn.Module):
    """UV tokens that read the features of any number of views."""

    def __init__(self, config: ModelConfig) -> None:
        """Sizes from `config`; views carry no index, so their order has no effect."""
        super().__init__()
        tokens = config.token_grid**2
        self.outputs = config.outputs
        self.uv_token = nn.Parameter(torch.empty(tokens, config.dim))
        nn.init.trunc_normal_(self.uv_token, std=0.02)
        self.uv_pos_embed = nn.Parameter(sincos_positions(config.token_grid, config.dim))
        self.linear_cond_proj = nn.Linear(config.dim, config.dim)
        self.linear_cond_proj2 = nn.Linear(config.dim, config.dim) if config.uv_attention else None
        self.layers = nn.ModuleList(
            MMBlock(config.dim, config.heads, dual=config.uv_attention, last=index == config.layers - 1)
            for index in range(config.layers)
        )
        self.norm_list = nn.ModuleList(nn.LayerNorm(config.dim, eps=_NORM_EPS) for _ in config.outputs)

    def forward(
        self, screen: Tensor, uv: Tensor | None, keep: Tensor | None = None, memory: ContextMemory | None = None
    ) -> list[Tensor]:
        """Screen and UV features [B,L,D], [B,M,D] -> the tokens [B,token_grid^2,D] at each output depth, normalised.

        keep [token_grid^2] bool leaves out the other tokens; in the result they have their initial values.
        memory holds the contexts of photos that came before, and takes up those of these.
        """
        start = self.uv_token + self.uv_pos_embed
        tokens = (start if keep is None else start[keep]).expand(screen.shape[0], -1, -1)
        cond = self.linear_cond_proj(screen)
        cond2 = None if self.linear_cond_proj2 is None or uv is None else self.linear_cond_proj2(uv)
        results = []
        for depth, layer in enumerate(self.layers, start=1):
            earlier = None if memory is None else memory.exchange(depth, (cond, cond2))
            tokens, cond, cond2 = layer(tokens, cond, cond2, earlier)
            for norm, output in zip(self.norm_list, self.outputs, strict=True):
                if output == depth:
                    results.append(norm(tokens if keep is None else _spread(tokens, keep, start)))
        return results


def _spread(tokens: Tensor, keep: Tensor, start: Tensor) -> Tensor:
    """Tokens [B,L,D] back at their places among all of `start` [T,D]."""
    whole = start.to(tokens.dtype).expand(len(tokens), -1, -1)
    return whole.index_copy(1, keep.nonzero()[:, 0], tokens)
