"""The authors' released weights: reading their files and running them with the released arithmetic.

Where the released program and the paper differ, this follows the released program: pixels with any mask count fully and
fall on the nearest texel of a corner-aligned grid, the confidence is divided by its maximum alone, unseen texels stay
black, blocks add attention to the tokens before a separate feed-forward, and features are read at texel centres.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from uika.canonical.surface import SurfaceTexels
from uika.model.backbone import MaskedBiasLinear, RotaryPositions
from uika.model.checkpoint import CheckpointError, listing
from uika.model.dinov3 import read_backbone
from uika.model.estimator import Estimator
from uika.model.estimator_file import read_estimator
from uika.model.gaussians import CanonicalGaussians
from uika.model.precision import Precision, arithmetic, halve
from uika.model.reconstructor import Reconstructor
from uika.model.released_estimator import load_estimator
from uika.model.released_file import ESTIMATOR, PREFIXES, compare, fill, read_shapes, read_tensors, unused_reason
from uika.model.released_sizes import SizeError, estimator_config, model_config
from uika.model.view_features import FeatureCache, Keep, content_keys
from uika.model.weight_kind import check_kind

_TABLES = "renderer.flame_model."
_BACKBONE = "encoder.model."
_HEAD_WIDTH = 64  # channels of an attention head of every published backbone that stands in

__all__ = ["ReleasedModel", "load", "load_estimator"]


class ReleasedModel(nn.Module):
    """The released network with its own texel tables: photos and masks in, canonical Gaussians out."""

    texel: Tensor  # [M] int64 row-major valid texels
    points: Tensor  # [M,3] metres, template surface at the texels
    corners: Tensor | None  # [M,3] int64 vertices of each texel's triangle
    barycentric: Tensor | None  # [M,3]

    def __init__(self, network: Reconstructor, estimator: Estimator, tables: Mapping[str, Tensor | None]) -> None:
        """`tables`: `texel`, `points`, `corners` and `barycentric`. Use `load` to read a file."""
        super().__init__()
        self.network = network
        self.estimator = estimator
        for name in ("texel", "points", "corners", "barycentric"):
            self.register_buffer(name, tables[name])
        self.precision: Precision = "float32"
        self.unused: dict[str, str] = {}

    def halve(self) -> None:
        """Store the weights in bfloat16; the estimator's decoder stays float32, as it is released."""
        self.network.halve()
        halve(self.estimator, exempt=(self.estimator.uv_head,))
        self.precision = "bfloat16"

    @property
    def surface(self) -> SurfaceTexels:
        """The template at the texels; rotations and sizes are absolute in this model and ask nothing of it."""
        upright = torch.eye(4, device=self.points.device)[:1].expand(len(self.points), -1)
        return SurfaceTexels(self.points[None], upright[None], torch.ones_like(self.points)[None])

    @torch.no_grad()
    def forward(
        self,
        images: Tensor,
        masks: Tensor,
        pixel_uv: Tensor | None = None,
        *,
        keep: Keep = "all",
        cache: FeatureCache | None = None,
    ) -> CanonicalGaussians:
        """Reconstruct B heads, each from V photos; the result unpacks as means, quats, scales, opacities, colors.

        images    [B,V,3,H,W] in [0,1] on a solid background, 512x512 for the released sizes
        masks     [B,V,1,H,W] in [0,1]; every pixel above 0 counts
        pixel_uv  [B,V,2,H,W] (u right, v down) in [0,1]; None asks the estimator
        keep      as in `Reconstructor.forward`
        cache     likewise, also for the estimator's features

        Raises ValueError for shapes that do not fit.
        """
        if pixel_uv is None:
            pixel_uv = self.estimate(images, cache)
        return self.network(images, masks, pixel_uv, None, self.texel, self.surface, keep, cache)

    @torch.no_grad()
    def estimate(self, images: Tensor, cache: FeatureCache | None = None) -> Tensor:
        """UV maps [B,V,2,H,W] of photos [B,V,3,H,W]; all views of an item inform each other."""
        with arithmetic(self.precision, images.device):
            if cache is None:
                features = self.estimator.features(images)
            else:
                photos = images.flatten(0, 1)
                keys = content_keys((photos,), "estimator")
                rows = cache.resolve(
                    "estimator", keys, lambda new: self.estimator.features(photos[new][None])[0].unbind()
                )
                features = torch.stack(rows).unflatten(0, images.shape[:2])
            return self.estimator.locate(features, (images.shape[-2], images.shape[-1]))


def load(
    path: str | Path,
    *,
    dtype: torch.dtype = torch.float32,
    estimator: str | Path | None = None,
    backbone: str | Path | None = None,
    texels: tuple[Tensor, Tensor] | None = None,
    strict: bool = True,
) -> ReleasedModel:
    """Read `uika.safetensors`; sizes and texel tables come from the file, weights stay in it until they are used.

    Args:
        path: the file.
        dtype: torch.float32 maps the file into memory; torch.bfloat16 halves the weights while reading.
        estimator: a file to take the estimator from, instead of the one inside: `fuvt_*.safetensors` or of our own.
        backbone: a DINOv3 file for the image encoder, instead of the one inside; needed where there is none inside.
        texels: valid texels [M] (int64, row-major) and template points [M,3] for a file without the head's tables.
        strict: False takes no offence at keys that belong to no known part.

    Raises:
        CheckpointError: the file is missing or damaged, or keys are missing, misshapen or unknown; it lists them.
    """
    path = Path(path)
    check_kind(path, ("released model",))
    shapes = read_shapes(path)
    tables = _tables(path, shapes, texels)
    given = _given(path, shapes, backbone)
    replaced = {name: "another backbone is used" for name in shapes if given and name.startswith(_BACKBONE)}
    shapes = {name: shape for name, shape in shapes.items() if name not in replaced}
    shapes |= {name: tuple(value.shape) for name, value in given.items()}
    inside = {name: shape for name, shape in shapes.items() if not name.startswith(_TABLES)}
    map_size = (
        math.isqrt(shapes[_TABLES + "valid_mask_flatten"][0]) if _TABLES + "valid_mask_flatten" in shapes else None
    )
    if map_size is not None and map_size**2 != shapes[_TABLES + "valid_mask_flatten"][0]:
        raise CheckpointError(f"{path}: {_TABLES}valid_mask_flatten holds no square map")
    try:
        with torch.device("meta"):
            network = Reconstructor(model_config(shapes, map_size))
            own = None if estimator is not None else Estimator(estimator_config(shapes, ESTIMATOR))
    except SizeError as error:
        raise CheckpointError(f"{path}: {listing('missing or misshapen', error.names)}") from error
    located = own if own is not None else read_estimator(estimator or path)
    if not isinstance(located, Estimator):
        raise CheckpointError(
            f"{estimator}: sees photos one by one; released weights need an estimator of the paper's kind"
        )
    model = ReleasedModel(network, located, tables)
    if dtype == torch.bfloat16:
        model.halve()
    elif dtype != torch.float32:
        raise ValueError(f"dtype must be torch.float32 or torch.bfloat16, got {dtype}")
    names = {new: old for old, new in ((name, _mapped(name)) for name in inside) if new is not None}
    expected = {
        name: value
        for name, value in model.state_dict().items()
        if name.startswith("network.") or (own is not None and name.startswith("estimator."))
    }
    last = str(network.config.layers - 1)
    model.unused = {name: reason for name in shapes if (reason := unused_reason(name, last))}
    taken = {old for new, old in names.items() if new in expected}
    if estimator is not None:
        model.unused |= {name: "another file's estimator is used" for name in shapes if name.startswith(ESTIMATOR)}
    read = {f"{_TABLES}{name}" for name in ("valid_mask_flatten", "v_template_pix", *_BINDING)}
    known = taken | set(model.unused) | read
    model.unused |= replaced
    unexpected = [name for name in shapes if name not in known] if strict else []
    compare(path, {name: tuple(value.shape) for name, value in expected.items()}, shapes, names, unexpected)
    fill(model, path, {name: names[name] for name in expected if names[name] not in given}, expected)
    if given:
        encoder = {f"network.{name}": value.float() for name, value in given.items() if f"network.{name}" in expected}
        model.load_state_dict(
            {name: value.to(expected[name].dtype) for name, value in encoder.items()}, strict=False, assign=True
        )
        model.requires_grad_(False)
    return model.eval()


def _given(path: Path, shapes: Mapping[str, tuple[int, ...]], backbone: str | Path | None) -> dict[str, Tensor]:
    """The tensors of a backbone's own file under the released names; empty where the file's own is used.

    Raises:
        CheckpointError: there is no backbone in either file, or it is of another size than the weights around it.
    """
    inside = any(name.startswith(_BACKBONE) and not name.endswith("mask_token") for name in shapes)
    fused = shapes.get("encoder.fusion_head.projects.0.weight", (0, 0))[1]
    if backbone is None:
        if not inside:
            raise CheckpointError(
                f"{path}: holds no image encoder of its own; give the DINOv3 backbone of {fused} channels that it was "
                "trained with as --backbone (`uika weights` says where to get it)"
            )
        return {}
    tensors = read_backbone(backbone)
    dim = tensors["patch_embed.proj.weight"].shape[0]
    if fused and dim != fused:
        raise CheckpointError(
            f"{backbone}: is a backbone of {dim} channels, but {path} was trained with one of {fused}; "
            "`uika weights` says where to get that"
        )
    # Hugging Face's files leave out what follows from the size.
    tensors.setdefault("rope_embed.periods", RotaryPositions(_HEAD_WIDTH).periods)
    blocks = {name.split(".")[1] for name in tensors if name.startswith("blocks.")}
    for block in blocks:
        tensors.setdefault(f"blocks.{block}.attn.qkv.bias_mask", MaskedBiasLinear(dim).bias_mask)
    return {_BACKBONE + name: value for name, value in tensors.items() if name != "mask_token"}


_BINDING = ("pix_to_v_idx_flatten", "pix_bary_flatten")


def _mapped(name: str) -> str | None:
    """This program's name of a released key."""
    if name.startswith(ESTIMATOR):
        return "estimator." + name.removeprefix(ESTIMATOR)
    return next((new + name.removeprefix(old) for old, new in PREFIXES.items() if name.startswith(old)), None)


def _tables(
    path: Path, shapes: Mapping[str, tuple[int, ...]], texels: tuple[Tensor, Tensor] | None
) -> dict[str, Tensor | None]:
    names = {"valid": "valid_mask_flatten", "points": "v_template_pix"}
    found = {short: _TABLES + name for short, name in names.items() if _TABLES + name in shapes}
    if texels is not None:
        texel, points = texels
        return {"texel": texel, "points": points, "corners": None, "barycentric": None}
    if len(found) < len(names):
        lacking = [_TABLES + name for short, name in names.items() if short not in found]
        raise CheckpointError(
            f"{path}: {listing('missing', lacking)}; give `texels` for a file without the head's tables"
        )
    optional = {short: _TABLES + name for short, name in zip(("corners", "barycentric"), _BINDING, strict=True)}
    read = dict(read_tensors(path, found | {short: name for short, name in optional.items() if name in shapes}))
    texel = read["valid"].bool().nonzero()[:, 0]
    counts = {names.get(short, short): len(value) for short, value in read.items() if short != "valid"}
    if any(count != len(texel) for count in counts.values()):
        raise CheckpointError(f"{path}: {len(texel)} valid texels, but tables of other lengths: {counts}")
    tables = {short: read.get(short) for short in ("corners", "barycentric")}
    return {"texel": texel, "points": read["points"].float().clone(), **tables}
