"""Dual joint attention block: UV tokens meet screen features and UV features (paper section 3.2, equations 5 to 7)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

Contexts = tuple[Tensor, Tensor | None]  # of the screen [B,M,C] and of UV [B,N,C]

_EPS = 1e-6
# Rows that pass a query projection or a feed-forward at once: bounds the memory of many views, changes no value.
_ROWS = 8192


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

    def forward(self, tokens: Tensor, context: Tensor, earlier: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        """tokens [B,L,C], context [B,M,C] -> their updates (the context's is None without `context_out`).

        `earlier` [B,E,C] is more context that is read and not updated.
        """
        read = context if earlier is None else torch.cat([earlier, context], dim=1)
        key = torch.cat(
            [self._split(self.to_k(tokens), self.norm_k), self._split(self.add_k_proj(read), self.norm_added_k)],
            dim=2,
        )
        value = torch.cat([self._split(self.to_v(tokens)), self._split(self.add_v_proj(read))], dim=2)

        def update(project: nn.Module, norm: nn.Module, out: nn.Module, rows: Tensor) -> Tensor:
            query = self._split(project(rows), norm).to(value.dtype)
            answer = functional.scaled_dot_product_attention(query, key.to(value.dtype), value)
            return out(answer.transpose(1, 2).flatten(2))

        token_update = in_rows(lambda rows: update(self.to_q, self.norm_q, self.to_out, rows), tokens)
        if self.add_q_proj is None or self.norm_added_q is None or self.to_add_out is None:
            return token_update, None
        parts = self.add_q_proj, self.norm_added_q, self.to_add_out
        return token_update, in_rows(lambda rows: update(*parts, rows), context)

    def _split(self, x: Tensor, norm: nn.Module | None = None) -> Tensor:
        """[B,L,C] -> [B,heads,L,C/heads], normalised in the precision of the norm's weights."""
        x = x.unflatten(2, (self.heads, -1)).transpose(1, 2)
        return x if norm is None else norm(x.to(next(norm.parameters()).dtype))


def in_rows(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """`function` of x [B,L,C], which treats each row by itself; without gradients a bounded number of them at once."""
    if torch.is_grad_enabled() or x.shape[1] <= _ROWS:
        return function(x)
    return torch.cat([function(rows) for rows in x.split(_ROWS, dim=1)], dim=1)


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
        """[B,L,dim]."""
        return in_rows(self.net, x)


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

    def forward(
        self, x: Tensor, cond: Tensor, cond2: Tensor | None, earlier: Contexts | None = None
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Tokens x [B,L,C], screen context [B,M,C], UV context [B,N,C] or None -> the three, updated.

        In the last block the contexts come back unchanged. `earlier` contexts are read and not updated.
        """
        old, old2 = earlier or (None, None)
        normed = self.norm1(x)
        update, cond_update = self.attn(normed, self.norm1_context(cond), _each(self.norm1_context, old))
        cond2_update = None
        if self.attn2 is not None and self.norm1_context2 is not None and cond2 is not None:
            update2, cond2_update = self.attn2(normed, self.norm1_context2(cond2), _each(self.norm1_context2, old2))
            update = update + update2
        x = _feed(x + update, self.ff)
        if self.ff_context is not None and cond_update is not None:
            cond = _feed(cond + cond_update, self.ff_context)
        if self.ff_context2 is not None and cond2 is not None and cond2_update is not None:
            cond2 = _feed(cond2 + cond2_update, self.ff_context2)
        return x, cond, cond2


def _each(norm: nn.Module, x: Tensor | None) -> Tensor | None:
    return None if x is None else norm(x)


def _feed(x: Tensor, feed_forward: FeedForward) -> Tensor:
    return x + feed_forward(functional.layer_norm(x, x.shape[-1:], eps=_EPS))
