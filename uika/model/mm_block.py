"""Dual joint attention block: UV tokens meet screen features and UV features (paper section 3.2, equations 5 to 7)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

_EPS = 1e-6


class JointAttention(nn.Module):
    """Attention over the concatenation [tokens; context], each stream with its own projections."""

    def __init__(self, dim: int, heads: int, context_out: bool) -> None:
        """`context_out` False leaves out what only the context's own update needs."""
        super().__init__()
        self.heads = heads
        self.to_q, self.to_k, self.to_v = (nn.Linear(dim, dim) for _ in range(3))
        self.add_k_proj, self.add_v_proj = (nn.Linear(dim, dim) for _ in range(2))
        self.norm_q, self.norm_k, self.norm_added_k = (nn.RMSNorm(dim // heads, eps=_EPS) for _ in range(3))
        self.to_out = nn.Sequential(nn.Linear(dim, dim))
        self.add_q_proj = nn.Linear(dim, dim) if context_out else None
        self.norm_added_q = nn.RMSNorm(dim // heads, eps=_EPS) if context_out else None
        self.to_add_out = nn.Linear(dim, dim) if context_out else None

    def forward(self, tokens: Tensor, context: Tensor) -> tuple[Tensor, Tensor | None]:
        """tokens [B,L,C], context [B,M,C] -> their updates (the context's is None without `context_out`)."""
        length = tokens.shape[1]
        query = self.norm_q(self._split(self.to_q(tokens)))
        if self.add_q_proj is not None and self.norm_added_q is not None:
            query = torch.cat([query, self.norm_added_q(self._split(self.add_q_proj(context)))], dim=2)
        key = torch.cat(
            [
                self.norm_k(self._split(self.to_k(tokens))),
                self.norm_added_k(self._split(self.add_k_proj(context))),
            ],
            dim=2,
        )
        value = torch.cat([self._split(self.to_v(tokens)), self._split(self.add_v_proj(context))], dim=2)
        out = functional.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)
        update = self.to_out(out[:, :length])
        return update, None if self.to_add_out is None else self.to_add_out(out[:, length:])

    def _split(self, x: Tensor) -> Tensor:
        return x.unflatten(2, (self.heads, -1)).transpose(1, 2)


class _GeluProjection(nn.Module):
    def __init__(self, dim: int, inner: int) -> None:
        super().__init__()
        self.proj = nn.Linear(dim, inner)

    def forward(self, x: Tensor) -> Tensor:
        return functional.gelu(self.proj(x), approximate="tanh")


class FeedForward(nn.Module):
    """Two layers with tanh-approximated GELU, four times as wide inside."""

    def __init__(self, dim: int) -> None:
        """`dim` -> 4*dim -> `dim`."""
        super().__init__()
        self.net = nn.Sequential(_GeluProjection(dim, 4 * dim), nn.Identity(), nn.Linear(4 * dim, dim))

    def forward(self, x: Tensor) -> Tensor:
        """[...,dim]."""
        return self.net(x)


class MMBlock(nn.Module):
    """One block; all three streams are updated from the same normalised tokens."""

    def __init__(self, dim: int, heads: int, dual: bool = True, last: bool = False) -> None:
        """`dual` False drops the UV branch (ablation), `last` drops the update of both contexts."""
        super().__init__()
        self.norm1 = nn.LayerNorm(dim)
        self.norm1_context = nn.LayerNorm(dim)
        self.attn = JointAttention(dim, heads, context_out=not last)
        self.ff = FeedForward(dim)
        self.ff_context = None if last else FeedForward(dim)
        self.norm1_context2 = nn.LayerNorm(dim) if dual else None
        self.attn2 = JointAttention(dim, heads, context_out=not last) if dual else None
        self.ff_context2 = FeedForward(dim) if dual and not last else None

    def forward(self, x: Tensor, cond: Tensor, cond2: Tensor | None) -> tuple[Tensor, Tensor, Tensor | None]:
        """Tokens x [B,L,C], screen context [B,M,C], UV context [B,N,C] or None -> the three, updated.

        In the last block the contexts come back unchanged.
        """
        normed = self.norm1(x)
        update, cond_update = self.attn(normed, self.norm1_context(cond))
        cond2_update = None
        if self.attn2 is not None and self.norm1_context2 is not None and cond2 is not None:
            update2, cond2_update = self.attn2(normed, self.norm1_context2(cond2))
            update = update + update2
        x = _feed(x + update, self.ff)
        if self.ff_context is not None and cond_update is not None:
            cond = _feed(cond + cond_update, self.ff_context)
        if self.ff_context2 is not None and cond2 is not None and cond2_update is not None:
            cond2 = _feed(cond2 + cond2_update, self.ff_context2)
        return x, cond, cond2


def _feed(x: Tensor, feed_forward: FeedForward) -> Tensor:
    return x + feed_forward(functional.layer_norm(x, x.shape[-1:], eps=_EPS))
