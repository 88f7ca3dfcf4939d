"""Facial correspondence estimator: photos in, UV coordinates of every pixel out (paper section 3.1, supplement A.1)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from uika.model.backbone import LayerScale, Mlp, VisionTransformer, standardize
from uika.model.config import EstimatorConfig
from uika.model.uv_head import UvHead

_NORM_EPS = 1e-5
_ROPE_BASE = 100.0
_LAYER_SCALE = 0.01


def grid_rotation(rows: int, columns: int, head_dim: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """(sin, cos), each [rows*columns, head_dim]: the first half turns with the row, the second with the column."""
    half = head_dim // 2
    frequencies = _ROPE_BASE ** (-torch.arange(0, half, 2, device=device, dtype=torch.float32) / half)
    axes = [torch.arange(count, device=device, dtype=torch.float32) for count in (rows, columns)]
    angles = [axis.flatten()[:, None] * frequencies for axis in torch.meshgrid(*axes, indexing="ij")]
    turned = torch.cat([angles[0].repeat(1, 2), angles[1].repeat(1, 2)], dim=1)
    return turned.sin(), turned.cos()


class ViewAttention(nn.Module):
    """Self attention with normalised queries and keys and rotary positions."""

    def __init__(self, dim: int, heads: int) -> None:
        """`heads` of dim/heads channels, a multiple of 4."""
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.q_norm = nn.LayerNorm(dim // heads, eps=_NORM_EPS)
        self.k_norm = nn.LayerNorm(dim // heads, eps=_NORM_EPS)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tensor, rope: tuple[Tensor, Tensor]) -> Tensor:
        """x [N,L,C], rope (sin, cos) [P,C/heads] repeated along the L = views * P tokens."""
        query, key, value = self.qkv(x).unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4).unbind(0)
        exact = self.q_norm.weight.dtype
        query, key = self.q_norm(query.to(exact)), self.k_norm(key.to(exact))
        query, key = (self._turn(part, rope).to(value.dtype) for part in (query, key))
        out = functional.scaled_dot_product_attention(query, key, value)
        return self.proj(out.transpose(1, 2).flatten(2))

    @staticmethod
    def _turn(x: Tensor, rope: tuple[Tensor, Tensor]) -> Tensor:
        sin, cos = (part.to(x.dtype) for part in rope)
        views = x.unflatten(2, (-1, len(sin)))
        first, second = views.unflatten(-1, (2, -1)).chunk(2, dim=-1)
        swapped = torch.cat([-second, first], dim=-1).flatten(-2)
        return (views * cos + swapped * sin).flatten(2, 3)


class ViewBlock(nn.Module):
    """Pre-norm attention and MLP, each behind a layer scale."""

    def __init__(self, dim: int, heads: int) -> None:
        """See `EstimatorConfig`."""
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=_NORM_EPS)
        self.attn = ViewAttention(dim, heads)
        self.ls1 = LayerScale(dim, _LAYER_SCALE)
        self.norm2 = nn.LayerNorm(dim, eps=_NORM_EPS)
        self.mlp = Mlp(dim)
        self.ls2 = LayerScale(dim, _LAYER_SCALE)

    def forward(self, x: Tensor, rope: tuple[Tensor, Tensor]) -> Tensor:
        """x [N,L,C]."""
        x = x + self.ls1(self.attn(self.norm1(x), rope))
        return x + self.ls2(self.mlp(self.norm2(x)))


class Aggregator(nn.Module):
    """Patch features of all views, exchanged by blocks that see one view (frame) or all of them (global) in turn."""

    def __init__(self, config: EstimatorConfig) -> None:
        """Views carry no index, so their order has no effect."""
        super().__init__()
        dim = config.backbone.dim
        self.patch_embed = VisionTransformer(config.backbone)
        self.head_dim = dim // config.heads
        self.frame_blocks = nn.ModuleList(ViewBlock(dim, config.heads) for _ in range(config.layers))
        self.global_blocks = nn.ModuleList(ViewBlock(dim, config.heads) for _ in range(config.layers))

    def features(self, images: Tensor) -> Tensor:
        """Photos [B,V,3,H,W] in [0,1] -> [B,V,h*w,C], each view by itself: what a photo's cache can hold."""
        return self.patch_embed(standardize(images.flatten(0, 1)))[-1].unflatten(0, images.shape[:2])

    def exchange(self, features: Tensor, grid: tuple[int, int]) -> list[Tensor]:
        """[B,V,h*w,C] of grid (h, w) -> one [B,V,h*w,2C] per pair of blocks, the frame's tokens beside the global's."""
        batch, views = features.shape[:2]
        rows, columns = grid
        rope = grid_rotation(rows, columns, self.head_dim, features.device)
        x = features.flatten(0, 1)
        outputs = []
        for frame, whole in zip(self.frame_blocks, self.global_blocks, strict=True):
            local = frame(x, rope)
            x = whole(local.unflatten(0, (batch, views)).flatten(1, 2), rope)
            x = x.unflatten(1, (views, rows * columns)).flatten(0, 1)
            outputs.append(torch.cat([local, x], dim=-1).unflatten(0, (batch, views)))
        return outputs


class Estimator(nn.Module):
    """UV coordinates of the pixels of any number of photos of one head."""

    def __init__(self, config: EstimatorConfig) -> None:
        """Random initialisation from the global generator."""
        super().__init__()
        self.config = config
        self.aggregator = Aggregator(config)
        self.uv_head = UvHead(config)

    def forward(self, images: Tensor) -> Tensor:
        """Photos [B,V,3,H,W] in [0,1] on a solid background -> UV maps [B,V,2,H,W] in (0,1), (u right, v down).

        Every pixel gets a value; those of the background mean nothing. Raises ValueError for shapes that do not fit.
        """
        return self.locate(self.features(images), (images.shape[-2], images.shape[-1]))

    def features(self, images: Tensor) -> Tensor:
        """What each photo of [B,V,3,H,W] says by itself, [B,V,h*w,C]; see `Aggregator.features`."""
        patch = self.config.backbone.patch_size
        if images.ndim != 5 or images.shape[2] != 3 or images.shape[3] % patch or images.shape[4] % patch:
            raise ValueError(f"images must be [B,V,3,H,W] with sides multiples of {patch}, got {list(images.shape)}")
        return self.aggregator.features(images)

    def locate(self, features: Tensor, size: tuple[int, int]) -> Tensor:
        """UV maps [B,V,2,*size] from the `features` of all views of pictures of `size` (H, W)."""
        grid = (size[0] // self.config.backbone.patch_size, size[1] // self.config.backbone.patch_size)
        return self.uv_head(self.aggregator.exchange(features, grid), grid)
