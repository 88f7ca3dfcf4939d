"""The released model once more, in float64 and plain functions over its own key names, to compare the real one with.

Written from the description of the released arithmetic alone; shares no code with `uika.model` or `uika.uv`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn import functional

Weights = Mapping[str, Tensor]


class Restatement:
    """Photos to Gaussians from the tensors of a released file."""

    def __init__(self, tensors: Weights, taps: tuple[int, ...], outputs: tuple[int, ...]) -> None:
        """`taps` of the backbone (0-based), `outputs` of the transformer (1-based depths)."""
        self.w = {name: value.double() if value.is_floating_point() else value for name, value in tensors.items()}
        self.taps, self.outputs = taps, outputs

    def __call__(self, images: Tensor, masks: Tensor, pixel_uv: Tensor | None = None) -> dict[str, Tensor]:
        """Images [B,V,3,H,W], masks [B,V,1,H,W], maps [B,V,2,H,W] -> attributes of each of B heads."""
        images = images.double()
        uv = self.estimate(images) if pixel_uv is None else pixel_uv.double()
        heads = [self._head(*item) for item in zip(images, masks, uv, strict=True)]
        return {name: torch.stack([head[name] for head in heads]) for name in heads[0]}

    def estimate(self, images: Tensor) -> Tensor:
        """Maps [B,V,2,H,W] of photos [B,V,3,H,W]."""
        return torch.stack([self._locate(item) for item in images.double()])

    def linear(self, name: str, x: Tensor) -> Tensor:
        return x @ self.w[f"{name}.weight"].flatten(1).mT + self.w.get(f"{name}.bias", 0.0)

    def norm(self, x: Tensor, eps: float, name: str | None = None) -> Tensor:
        centred = x - x.mean(-1, keepdim=True)
        x = centred / (centred.square().mean(-1, keepdim=True) + eps).sqrt()
        return x if name is None else x * self.w[f"{name}.weight"] + self.w[f"{name}.bias"]

    def conv(self, name: str, x: Tensor, padding: int = 0, stride: int = 1) -> Tensor:
        return functional.conv2d(x, self.w[f"{name}.weight"], self.w.get(f"{name}.bias"), stride, padding)

    def dino(self, prefix: str, images: Tensor, taps: tuple[int, ...]) -> list[Tensor]:
        """Normalised patch tokens [V,h*w,C] after each of the blocks `taps`."""
        mean, std = torch.tensor([0.485, 0.456, 0.406]).double(), torch.tensor([0.229, 0.224, 0.225]).double()
        size = self.w[f"{prefix}patch_embed.proj.weight"].shape[-1]
        x = (images - mean[:, None, None]) / std[:, None, None]
        patches = self.conv(f"{prefix}patch_embed.proj", x, stride=size)
        rows, columns = patches.shape[-2:]
        start = [self.w[f"{prefix}{name}"].expand(len(images), -1, -1) for name in ("cls_token", "storage_tokens")]
        x = torch.cat([*start, patches.flatten(2).mT], dim=1)
        first = x.shape[1] - rows * columns
        periods = self.w[f"{prefix}rope_embed.periods"]
        angles = torch.zeros(rows * columns, 2 * len(periods)).double()
        for row in range(rows):
            for column in range(columns):
                place = [2 * (row + 0.5) / rows - 1, 2 * (column + 0.5) / columns - 1]
                angles[row * columns + column] = torch.cat([2 * math.pi * at / periods for at in place])
        angles = angles.repeat(1, 2)
        results = {}
        for block in range(max(taps) + 1):
            name = f"{prefix}blocks.{block}."
            normed = self.norm(x, 1e-5, f"{name}norm1")
            bias = self.w[f"{name}attn.qkv.bias"] * self.w[f"{name}attn.qkv.bias_mask"]
            qkv = normed @ self.w[f"{name}attn.qkv.weight"].mT + bias
            query, key, value = (split_heads(part, 4 * len(periods)) for part in qkv.chunk(3, dim=-1))
            turned = [torch.cat([p[:, :, :first], rotate(p[:, :, first:], angles)], dim=2) for p in (query, key)]
            x = x + self.w[f"{name}ls1.gamma"] * self.linear(f"{name}attn.proj", attend(*turned, value))
            normed = self.norm(x, 1e-5, f"{name}norm2")
            inner = functional.gelu(self.linear(f"{name}mlp.fc1", normed))
            x = x + self.w[f"{name}ls2.gamma"] * self.linear(f"{name}mlp.fc2", inner)
            results[block] = self.norm(x, 1e-5, f"{prefix}norm")[:, first:]
        return [results[tap] for tap in taps]

    def _locate(self, images: Tensor) -> Tensor:
        prefix = "uv_wrapper.model.aggregator."
        size = self.w[f"{prefix}patch_embed.patch_embed.proj.weight"].shape[-1]
        views, rows, columns = len(images), images.shape[-2] // size, images.shape[-1] // size
        depth = 1 + max(int(n.split(".")[5]) for n in self.w if n.startswith(f"{prefix}patch_embed.blocks."))
        x = self.dino(f"{prefix}patch_embed.", images, (depth - 1,))[0]
        width = len(self.w[f"{prefix}frame_blocks.0.attn.q_norm.weight"])
        half = width // 2
        frequencies = 100.0 ** (-torch.arange(0, half, 2).double() / half)
        grid = torch.cartesian_prod(torch.arange(rows), torch.arange(columns)).double()
        angles = [(grid[:, axis, None] * frequencies).repeat(1, 2) for axis in (0, 1)]
        outputs = []
        for layer in range(4):
            local = x = self._view_block(f"{prefix}frame_blocks.{layer}.", x, angles, width)
            joined = x.reshape(1, views * rows * columns, -1)
            again = [part.repeat(views, 1) for part in angles]
            x = self._view_block(f"{prefix}global_blocks.{layer}.", joined, again, width).reshape(x.shape)
            outputs.append(torch.cat([local, x], dim=-1))
        return self._uv_head(outputs, rows, columns, size)

    def _view_block(self, name: str, x: Tensor, angles: list[Tensor], width: int) -> Tensor:
        qkv = self.linear(f"{name}attn.qkv", self.norm(x, 1e-5, f"{name}norm1"))
        query, key, value = (split_heads(part, width) for part in qkv.chunk(3, dim=-1))
        turned = []
        for part, norm in ((query, "q_norm"), (key, "k_norm")):
            halves = self.norm(part, 1e-5, f"{name}attn.{norm}").chunk(2, dim=-1)
            turned.append(torch.cat([rotate(h, a) for h, a in zip(halves, angles, strict=True)], dim=-1))
        x = x + self.w[f"{name}ls1.gamma"] * self.linear(f"{name}attn.proj", attend(turned[0], turned[1], value))
        inner = functional.gelu(self.linear(f"{name}mlp.fc1", self.norm(x, 1e-5, f"{name}norm2")))
        return x + self.w[f"{name}ls2.gamma"] * self.linear(f"{name}mlp.fc2", inner)

    def _uv_head(self, tokens: list[Tensor], rows: int, columns: int, patch: int) -> Tensor:
        prefix = "uv_wrapper.model.uv_head."
        levels = []
        for index, level in enumerate(tokens):
            x = self.norm(level, 1e-5, f"{prefix}norm").mT.reshape(len(level), -1, rows, columns)
            x = place(self.conv(f"{prefix}projects.{index}", x), columns / rows)
            levels.append(self.conv(f"{prefix}scratch.layer{index + 1}_rn", self._resized(prefix, index, x), 1))
        x = levels[3]
        for index in (3, 2, 1, 0):
            name = f"{prefix}scratch.refinenet{index + 1}."
            if index < 3:
                x = x + self._unit(f"{name}resConfUnit1.", levels[index], rectified=True)
            x = self._unit(f"{name}resConfUnit2.", x, rectified=True)
            size = levels[index - 1].shape[-2:] if index else [2 * n for n in levels[0].shape[-2:]]
            x = functional.interpolate(x, size=tuple(size), mode="bilinear", align_corners=True)
            x = self.conv(f"{name}out_conv", x)
        x = self.conv(f"{prefix}scratch.output_conv1", x, 1)
        x = functional.interpolate(x, size=(rows * patch, columns * patch), mode="bilinear", align_corners=True)
        x = self.conv(f"{prefix}scratch.output_conv2.0", place(x, columns / rows), 1).relu()
        return self.conv(f"{prefix}scratch.output_conv2.2", x)[:, :2].sigmoid()

    def _resized(self, prefix: str, index: int, x: Tensor) -> Tensor:
        name = f"{prefix}resize_layers.{index}"
        if index < 2:
            stride = (4, 2)[index]
            return functional.conv_transpose2d(x, self.w[f"{name}.weight"], self.w[f"{name}.bias"], stride)
        return x if index == 2 else self.conv(name, x, 1, stride=2)

    def _unit(self, name: str, x: Tensor, rectified: bool) -> Tensor:
        y = self.conv(f"{name}conv2", self.conv(f"{name}conv1", x.relu(), 1).relu(), 1)
        return y + (x.relu() if rectified else x)

    def _head(self, images: Tensor, masks: Tensor, uv: Tensor) -> dict[str, Tensor]:
        valid = self.w["renderer.flame_model.valid_mask_flatten"].bool()
        size = math.isqrt(len(valid))
        side = images.shape[-2]
        reprojected = torch.stack(
            [scatter(images[v : v + 1], masks[v : v + 1], uv[v : v + 1], side)[:3] for v in range(len(images))]
        )
        pooled = scatter(images, masks, uv, size)
        logs = pooled[3].log1p()
        observed = torch.cat([pooled[:3], (logs / logs.max().clamp_min(1e-6))[None]])
        screen = self.fuse("encoder.fusion_head.", images)
        around = self.fuse("encoder.uv_fusion_head.", reprojected)
        features = self.decode(self.transform(screen, around), observed)
        x = features.flatten(1)[:, valid].mT
        seen = observed.flatten(1)[:, valid].mT
        for layer in (0, 2, 4):
            x = self.linear(f"gs_decoder.mlp_net.layers.{layer}", x)
            x = x if layer == 4 else x * x.sigmoid()
        out = "gs_decoder.gs_net.out_layers."
        mixed = self.linear(f"{out}shs", torch.cat([x, seen], dim=1)).sigmoid()
        turn = self.linear(f"{out}rotation", x)
        offset = (self.linear(f"{out}xyz", x).sigmoid() - 0.5) * 0.2
        return {
            "means": self.w["renderer.flame_model.v_template_pix"] + offset,
            "quats": turn / turn.norm(dim=1, keepdim=True),
            "scales": self.linear(f"{out}scaling", x).exp().clamp(0, 0.01),
            "opacities": self.linear(f"{out}opacity", x).sigmoid()[:, 0],
            "colors": mixed[:, 3:] * mixed[:, :3] + (1 - mixed[:, 3:]) * seen[:, :3],
        }

    def fuse(self, prefix: str, images: Tensor) -> Tensor:
        """Tokens [V*h*w,D] of pictures [V,3,H,W]."""
        taps = self.dino("encoder.model.", images, self.taps)
        mixed = [self.linear(f"{prefix}projects.{index}", tap) for index, tap in enumerate(taps)]
        return self.linear(f"{prefix}output_conv", torch.cat(mixed, dim=-1)).flatten(0, 1)

    def transform(self, screen: Tensor, around: Tensor) -> list[Tensor]:
        """Tokens [T,D] of the output depths, from features [L,D] of screen and UV."""
        t = "transformer."
        x = (self.w[f"{t}uv_token"] + self.w[f"{t}uv_pos_embed"])[None]
        cond = self.linear(f"{t}linear_cond_proj", screen)[None]
        cond2 = self.linear(f"{t}linear_cond_proj2", around)[None]
        results = []
        for depth in range(1, max(self.outputs) + 1):
            name, last = f"{t}layers.{depth - 1}.", depth == max(self.outputs)
            n = self.norm(x, 1e-5, f"{name}norm1")
            update, back = self._joint(f"{name}attn.", n, self.norm(cond, 1e-5, f"{name}norm1_context"), last)
            update2, back2 = self._joint(f"{name}attn2.", n, self.norm(cond2, 1e-5, f"{name}norm1_context2"), last)
            x = self._feed(f"{name}ff", x + update + update2)
            if not last:
                cond = self._feed(f"{name}ff_context", cond + back)
                cond2 = self._feed(f"{name}ff_context2", cond2 + back2)
            if depth in self.outputs:
                results.append(self.norm(x, 1e-6, f"{t}norm_list.{self.outputs.index(depth)}")[0])
        return results

    def _joint(self, name: str, n: Tensor, c: Tensor, last: bool) -> tuple[Tensor, Tensor]:
        width = len(self.w[f"{name}norm_q.weight"])

        def part(project: str, x: Tensor, norm: str | None = None) -> Tensor:
            heads = split_heads(self.linear(f"{name}{project}", x), width)
            if norm is None:
                return heads
            return heads / (heads.square().mean(-1, keepdim=True) + 1e-6).sqrt() * self.w[f"{name}{norm}.weight"]

        query = torch.cat([part("to_q", n, "norm_q"), part("add_q_proj", c, "norm_added_q")], dim=2)
        key = torch.cat([part("to_k", n, "norm_k"), part("add_k_proj", c, "norm_added_k")], dim=2)
        value = torch.cat([part("to_v", n), part("add_v_proj", c)], dim=2)
        answer = attend(query, key, value)
        tokens, context = answer[:, : n.shape[1]], answer[:, n.shape[1] :]
        return self.linear(f"{name}to_out.0", tokens), context if last else self.linear(f"{name}to_add_out", context)

    def _feed(self, name: str, x: Tensor) -> Tensor:
        inner = self.linear(f"{name}.net.0.proj", self.norm(x, 1e-6))
        return x + self.linear(f"{name}.net.2", functional.gelu(inner, approximate="tanh"))

    def decode(self, tokens: list[Tensor], observed: Tensor) -> Tensor:
        """Features [C,S,S] from tokens [T,D] of four depths and the aggregate [4,S,S]."""
        d = "gs_decoder.dpt_decoder."
        grid = math.isqrt(len(tokens[0]))

        def beside(x: Tensor) -> Tensor:
            size = (x.shape[-2], x.shape[-1])
            small = functional.interpolate(observed[None], size=size, mode="bilinear", antialias=True)
            return torch.cat([x, small], dim=1)

        levels = []
        for index, depth in enumerate(tokens):
            x = self.conv(f"{d}projects.{index}", depth.mT.reshape(1, -1, grid, grid))
            levels.append(self.conv(f"{d}layer_rn.{index}", beside(self._resized(d, index, x)), 1))
        x = levels[3]
        for index in range(4):
            name = f"{d}refinenet.{index}."
            if index:
                x = x + self._unit(f"{name}resConfUnit1.", levels[3 - index], rectified=False)
            x = self._unit(f"{name}resConfUnit2.", x, rectified=False)
            size = (4 * grid, 4 * grid) if index == 3 else tuple(levels[2 - index].shape[-2:])
            x = self.conv(f"{name}out_conv", functional.interpolate(x, size=size, mode="bilinear"))
        x = functional.leaky_relu(self.conv(f"{d}output_conv.0", beside(x), 1), 0.01)
        return self.conv(f"{d}output_conv.2", x, 1)[0]


def split_heads(x: Tensor, width: int) -> Tensor:
    """[B,L,C] -> [B,C/width,L,width]."""
    return x.reshape(x.shape[0], x.shape[1], -1, width).transpose(1, 2)


def attend(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """[B,heads,L,width] of each -> [B,L,heads*width]."""
    share = (query @ key.mT / math.sqrt(query.shape[-1])).softmax(dim=-1)
    return (share @ value).transpose(1, 2).flatten(2)


def rotate(x: Tensor, angles: Tensor) -> Tensor:
    """Turn halves of the last axis against each other."""
    first, second = x.chunk(2, dim=-1)
    return x * angles.cos() + torch.cat([-second, first], dim=-1) * angles.sin()


def place(x: Tensor, aspect: float) -> Tensor:
    """Add a tenth of the sine-cosine embedding of the grid to maps [V,C,h,w]."""
    rows, columns = x.shape[-2:]
    channels = x.shape[1]
    diagonal = math.sqrt(aspect**2 + 1)
    frequencies = 100.0 ** (-torch.arange(channels // 4).double() / (channels / 4))
    across, down = (
        torch.linspace(-s * (n - 1) / n, s * (n - 1) / n, n).double()
        for s, n in ((aspect / diagonal, columns), (1 / diagonal, rows))
    )
    embedding = torch.zeros(channels, rows, columns).double()
    for row in range(rows):
        for column in range(columns):
            parts = []
            for at in (across[column], down[row]):
                parts += [(at * frequencies).sin(), (at * frequencies).cos()]
            embedding[:, row, column] = torch.cat(parts)
    return x + 0.1 * embedding


def scatter(images: Tensor, masks: Tensor, uv: Tensor, size: int) -> Tensor:
    """Mean colour and count [4,S,S] of the pixels of views [V,...] on a corner-aligned atlas."""
    sums = torch.zeros(4, size * size).double()
    for image, mask, place_ in zip(images, masks, uv, strict=True):
        chosen = (mask[0] > 0).flatten()
        column_row = (place_.float().flatten(1)[:, chosen].clamp(0, 1) * (size - 1)).round().long()
        cells = column_row[1] * size + column_row[0]
        colours = image.flatten(1)[:, chosen]
        for channel, values in enumerate((*colours, torch.ones_like(colours[0]))):
            sums[channel].index_add_(0, cells, values)
    count = sums[3].clone()
    sums[:3] /= count.clamp_min(1)
    return sums.view(4, size, size)
