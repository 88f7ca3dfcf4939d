"""Operations of the network at any size, without running it: `python -m benchmarks.model_operations --preset paper`.

Every stage passes once on tensors without memory while torch counts multiplications and additions. Seconds are
computed, not measured: operations over the rates of this machine for matrix products and for attention, which are
measured first. What is bound by memory comes on top.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.figures import lines
from benchmarks.harness import interleaved, markdown, save
from uika.head import load_head, uv_texels
from uika.model import ESTIMATORS, PRESETS, Estimator, Reconstructor, SurfaceTexels
from uika.model.transformer import ContextMemory
from uika.model.view_features import covered_tokens

STAGES = ("encoders", "transformer", "decoder")
RUNS = ("fp32 dense", "bf16 dense", "bf16 foreground", "bf16 cached increment")


@dataclass(frozen=True)
class Kept:
    """What the stages work on: patches of one photo, patches of its reprojected image, UV tokens."""

    screen: int
    uv: int
    tokens: int


@dataclass(frozen=True)
class Rates:
    """Operations a second."""

    product: float
    attention: float

    def seconds(self, operations: Counter[str]) -> float:
        """Time of `operations` if nothing else took any."""
        return operations["product"] / self.product + operations["attention"] / self.attention


class Counted:
    """A model of a preset without weights."""

    def __init__(self, preset: str, texels: int) -> None:
        self.config = PRESETS[preset]
        with torch.device("meta"):
            self.model = Reconstructor(self.config).eval()
            self.estimator = Estimator(ESTIMATORS[preset]).eval()
            points = torch.zeros(1, texels, 3)
            self.surface = SurfaceTexels(points, torch.zeros(1, texels, 4), points)

    def stages(self, views: int, kept: Kept, new: int | None = None) -> dict[str, Counter[str]]:
        """Operations of each stage for `views` photos, of which only the last `new` are encoded if that is given."""
        encoded = views if new is None else new
        model, grid = self.model, self.config.token_grid
        transformer, width = model.transformer, self.config.dim
        # A row of as many patches takes the same operations as any other arrangement of them.
        photo, map_ = (self._strip(encoded, count) for count in (kept.screen, kept.uv))

        def attend(photos: int, memory: ContextMemory | None) -> list[Tensor]:
            features = (_meta(1, photos * count, width) for count in (kept.screen, kept.uv))
            return transformer(*features, None, memory)

        whole = transformer.uv_token, transformer.uv_pos_embed
        memory = None if new is None else ContextMemory()
        with torch.no_grad():
            transformer.uv_token, transformer.uv_pos_embed = (nn.Parameter(part[: kept.tokens]) for part in whole)
            if new is not None:
                attend(views - new, memory)
            attention = _count(lambda: attend(encoded, memory))
            transformer.uv_token, transformer.uv_pos_embed = whole
            encoders = _count(lambda: (model.encoder.screen(photo), model.encoder.uv(map_)))
            tokens = [_meta(1, grid * grid, width) for _ in range(4)]
            observed = _meta(1, 4 + 4 * self.config.surface, self.config.map_size, self.config.map_size)
            decoder = _count(lambda: self._decode(tokens, observed))
        return {"encoders": encoders, "transformer": attention, "decoder": decoder}

    def correspondence(self, views: int) -> Counter[str]:
        """Operations of the estimator."""
        side = self.config.image_size
        with torch.no_grad():
            return _count(lambda: self.estimator(_meta(1, views, 3, side, side)))

    def _decode(self, tokens: list[Tensor], observed: Tensor) -> object:
        decoder, texels = self.model.gs_decoder, self.surface.points.shape[1]
        decoder.dpt_decoder(tokens, observed)
        features, seen = _meta(1, texels, self.config.dpt_features), _meta(1, texels, 4)
        palette = decoder.palette(features, seen) if decoder.gs_net.palette else None
        return decoder.gs_net(decoder.mlp_net(features), seen, self.surface, palette)

    def _strip(self, photos: int, patches: int) -> Tensor:
        patch = self.config.backbone.patch_size
        return _meta(photos, 3, patch, patch * patches)


def _meta(*shape: int) -> Tensor:
    return torch.empty(*shape, device="meta")


def _count(run: Callable[[], object]) -> Counter[str]:
    with FlopCounterMode(display=False) as counter:
        run()
    result: Counter[str] = Counter()
    for operation, count in counter.get_flop_counts()["Global"].items():
        name = str(operation)
        result["attention" if "bmm" in name or "scaled_dot_product" in name else "product"] += count
    return result


def measure_rates(kind: torch.dtype) -> Rates:
    """Rates of layers of the paper's width in numbers of this kind."""
    rows, width, heads = 4096, 1024, 16
    x, weight = torch.randn(rows, width).to(kind), torch.randn(4 * width, width).to(kind)
    query = torch.randn(1, heads, rows, width // heads).to(kind)
    work = {
        "product": lambda: functional.linear(x, weight),
        "attention": lambda: functional.scaled_dot_product_attention(query, query, query),
    }
    times = interleaved(work, dict.fromkeys(work, 5), warm=1)
    operations = {"product": 2 * rows * 4 * width * width, "attention": 4 * rows * rows * width}
    return Rates(**{name: 1e3 * operations[name] / times[name].best for name in work})


def main(argv: Sequence[str] | None = None) -> int:
    """Count, and write the table and the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="paper", choices=sorted(PRESETS))
    parser.add_argument("--views", type=int, nargs="+", default=[1, 2, 4, 8, 16, 32])
    parser.add_argument("--kept", type=float, default=0.38, help="share of patches that are foreground")
    parser.add_argument("--name", default="model_operations", help="of the result files")
    options = parser.parse_args(argv)
    config = PRESETS[options.preset]
    valid = uv_texels(load_head().without_bust, config.map_size).texel
    counted = Counted(options.preset, len(valid))
    patches = (config.image_size // config.backbone.patch_size) ** 2
    dense = Kept(patches, patches, config.token_grid**2)
    few = round(options.kept * patches)
    foreground = Kept(few, few, int(covered_tokens(valid, config.map_size, config.token_grid).sum()))
    rates = {"fp32": measure_rates(torch.float32), "bf16": measure_rates(torch.bfloat16)}
    rows = []
    for views in options.views:
        works = {"dense": counted.stages(views, dense), "foreground": counted.stages(views, foreground)}
        works["cached increment"] = counted.stages(views, foreground, new=1) if views > 1 else works["foreground"]
        tera = {
            f"{name} {stage} TFLOP": round(sum(works[name][stage].values()) / 1e12, 2)
            for name in ("dense", "foreground")
            for stage in STAGES
        }
        seconds = {}
        for run in RUNS:
            kind, name = run.split(" ", 1)
            seconds[f"{run} s"] = round(sum(rates[kind].seconds(work) for work in works[name].values()), 1)
        located = counted.correspondence(views)
        rows.append({"views": views, **tera, "estimator TFLOP": round(sum(located.values()) / 1e12, 2), **seconds})
    speeds = "; ".join(
        f"{kind} {rate.product / 1e9:.0f} and {rate.attention / 1e9:.0f} GFLOP/s" for kind, rate in rates.items()
    )
    text = (
        f"Preset `{options.preset}`, {options.kept:.0%} of the patches are foreground. Seconds are computed from the "
        f"measured rates of matrix products and of attention, {speeds}; they were not timed.\n\n{markdown(rows)}"
    )
    save(options.name, "Network: operations", text, {"rows": rows})
    curves = {run: [(row["views"], row[f"{run} s"]) for row in rows] for run in RUNS}
    lines(options.name, {("views", "computed seconds"): curves})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
