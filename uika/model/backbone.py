"""Vision transformer with 2-D rotary positions, the feature extractor of photos and reprojected views.

Layer for layer the architecture of DINOv3, with its parameter names, so that one class serves a small backbone trained
from scratch and a pretrained one.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from uika.model.config import BackboneConfig

_ROPE_BASE = 100.0
_NORM_EPS = 1e-5
# Statistics of ImageNet, which pretrained backbones expect.
_MEAN = (0.485, 0.456, 0.406)
_STD = (0.229, 0.224, 0.225)


def standardize(images: Tensor) -> Tensor:
    """Images [...,3,H,W] in [0,1] -> zero mean and unit deviation over natural images."""
    mean, std = (images.new_tensor(values)[:, None, None] for values in (_MEAN, _STD))
    return (images - mean) / std


class RotaryPositions(nn.Module):
    """Sines and cosines of patch positions; coordinates run from -1 to 1 along each axis."""

    periods: Tensor

    def __init__(self, head_dim: int) -> None:
        """`head_dim` must be a multiple of 4: a quarter of it per axis and phase."""
        super().__init__()
        quarter = head_dim // 4
        self.register_buffer("periods", _ROPE_BASE ** (torch.arange(quarter, dtype=torch.float32) / quarter))

    def forward(self, rows: int, columns: int) -> tuple[Tensor, Tensor]:
        """(sin, cos), each [rows*columns, head_dim]."""
        axes = [2 * (torch.arange(n, device=self.periods.device) + 0.5) / n - 1 for n in (rows, columns)]
        coords = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 2)
        angles = (2 * math.pi * coords[:, :, None] / self.periods).flatten(1)
        angles = angles.repeat(1, 2)
        return angles.sin(), angles.cos()


class MaskedBiasLinear(nn.Linear):
    """The fused q,k,v projection; the bias of the keys is switched off."""

    bias_mask: Tensor

    def __init__(self, dim: int) -> None:
        """`dim` -> 3*dim."""
        super().__init__(dim, 3 * dim)
        self.register_buffer("bias_mask", torch.cat([torch.ones(dim), torch.zeros(dim), torch.ones(dim)]))

    def forward(self, x: Tensor) -> Tensor:
        """[...,dim] -> [...,3*dim]."""
        return functional.linear(x, self.weight, self.bias * self.bias_mask)


class Attention(nn.Module):
    """Self attention; rotary positions turn the last tokens (the patches) only."""

    def __init__(self, dim: int, heads: int) -> None:
        """`heads` of dim/heads channels."""
        super().__init__()
        self.heads = heads
        self.qkv = MaskedBiasLinear(dim)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tensor, rope: tuple[Tensor, Tensor], lengths: list[int] | None = None) -> Tensor:
        """x [N,L,C] with rope (sin, cos) of its last patches, or of all L tokens.

        With `lengths`, x [1,L,C] is a pack of images that many tokens long, which do not see each other.
        """
        query, key, value = self.qkv(x).unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4).unbind(0)
        query, key = _rotate(query, rope), _rotate(key, rope)
        if lengths is None:
            out = functional.scaled_dot_product_attention(query, key, value)
        else:
            images = zip(*(part.split(lengths, dim=2) for part in (query, key, value)), strict=True)
            out = torch.cat([functional.scaled_dot_product_attention(*image) for image in images], dim=2)
        return self.proj(out.transpose(1, 2).flatten(2))


def _rotate(x: Tensor, rope: tuple[Tensor, Tensor]) -> Tensor:
    sin, cos = (part.to(x.dtype) for part in rope)
    start = x.shape[2] - len(sin)
    prefix, patches = x[:, :, :start], x[:, :, start:]
    first, second = patches.chunk(2, dim=-1)
    turned = patches * cos + torch.cat([-second, first], dim=-1) * sin
    return torch.cat([prefix, turned], dim=2) if start else turned


class LayerScale(nn.Module):
    """Learned gain per channel."""

    def __init__(self, dim: int, value: float) -> None:
        """All gains start at `value`."""
        super().__init__()
        self.gamma = nn.Parameter(torch.full((dim,), value))

    def forward(self, x: Tensor) -> Tensor:
        """[...,dim]."""
        return x * self.gamma


class Mlp(nn.Module):
    """Two layers with exact GELU, four times as wide inside."""

    def __init__(self, dim: int) -> None:
        """`dim` -> 4*dim -> `dim`."""
        super().__init__()
        self.fc1 = nn.Linear(dim, 4 * dim)
        self.fc2 = nn.Linear(4 * dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        """[...,dim]."""
        return self.fc2(functional.gelu(self.fc1(x)))


class Block(nn.Module):
    """Pre-norm attention and MLP, each behind a layer scale."""

    def __init__(self, dim: int, heads: int, layer_scale: float) -> None:
        """See `BackboneConfig`."""
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=_NORM_EPS)
        self.attn = Attention(dim, heads)
        self.ls1 = LayerScale(dim, layer_scale)
        self.norm2 = nn.LayerNorm(dim, eps=_NORM_EPS)
        self.mlp = Mlp(dim)
        self.ls2 = LayerScale(dim, layer_scale)

    def forward(self, x: Tensor, rope: tuple[Tensor, Tensor], lengths: list[int] | None = None) -> Tensor:
        """See `Attention.forward`."""
        x = x + self.ls1(self.attn(self.norm1(x), rope, lengths))
        return x + self.ls2(self.mlp(self.norm2(x)))


class PatchEmbed(nn.Module):
    """Patches to tokens."""

    def __init__(self, dim: int, patch_size: int) -> None:
        """One token of `dim` channels per patch."""
        super().__init__()
        self.proj = nn.Conv2d(3, dim, patch_size, stride=patch_size)

    def forward(self, images: Tensor) -> Tensor:
        """[N,3,H,W] -> [N,C,H/p,W/p]."""
        return self.proj(images)


class VisionTransformer(nn.Module):
    """Patch features at several depths."""

    def __init__(self, config: BackboneConfig) -> None:
        """Random initialisation; `config.frozen` switches gradients off."""
        super().__init__()
        self.taps = config.taps
        self.patch_size = config.patch_size
        self.cls_token = nn.Parameter(torch.empty(1, 1, config.dim))
        self.storage_tokens = nn.Parameter(torch.empty(1, config.storage_tokens, config.dim))
        nn.init.normal_(self.cls_token, std=0.02)
        nn.init.normal_(self.storage_tokens, std=0.02)
        self.patch_embed = PatchEmbed(config.dim, config.patch_size)
        self.rope_embed = RotaryPositions(config.dim // config.heads)
        self.blocks = nn.ModuleList(Block(config.dim, config.heads, config.layer_scale) for _ in range(config.depth))
        self.norm = nn.LayerNorm(config.dim, eps=_NORM_EPS)
        if config.frozen:
            self.requires_grad_(False)

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        """Normalised images [N,3,H,W], sides multiples of the patch size -> [N,h*w,C] patch tokens of each tap.

        Every tap passes the final LayerNorm; class and storage tokens are dropped.
        """
        patches, rope = self._embed(images)
        prefix = self._prefix().expand(len(patches), -1, -1)
        start = prefix.shape[1]
        return tuple(tap[:, start:] for tap in self._run(torch.cat([prefix, patches], dim=1), rope))

    def kept(self, images: Tensor, keep: Tensor) -> list[tuple[Tensor, ...]]:
        """Like `forward` for the patches of keep [N,h*w] alone, the others being absent: one [L,C] per tap and image.

        Images of any number of patches pass together, one after the other in a row without padding.
        """
        patches, rope = self._embed(images)
        prefix = self._prefix()[0]
        start = len(prefix)
        unturned = (torch.zeros_like(rope[0][:start]), torch.ones_like(rope[1][:start]))
        lengths = [start + count for count in keep.sum(dim=1).tolist()]
        row = torch.cat([part for index, mask in enumerate(keep) for part in (prefix, patches[index, mask])])
        turns = tuple(
            torch.cat([part for mask in keep for part in (still, turn[mask])])
            for still, turn in zip(unturned, rope, strict=True)
        )
        taps = [tap[0].split(lengths) for tap in self._run(row[None], (turns[0], turns[1]), lengths)]
        return [tuple(tap[start:] for tap in image) for image in zip(*taps, strict=True)]

    def _embed(self, images: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        patches = self.patch_embed(images)
        return patches.flatten(2).transpose(1, 2), self.rope_embed(*patches.shape[-2:])

    def _prefix(self) -> Tensor:
        return torch.cat([self.cls_token, self.storage_tokens], dim=1)

    def _run(self, tokens: Tensor, rope: tuple[Tensor, Tensor], lengths: list[int] | None = None) -> tuple[Tensor, ...]:
        taps = []
        for index, block in enumerate(self.blocks[: max(self.taps) + 1]):
            tokens = block(tokens, rope, lengths)
            if index in self.taps:
                taps.append(self.norm(tokens))
        return tuple(taps)
