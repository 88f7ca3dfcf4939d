"""The authors' released weights: reading their files and running them with the released arithmetic.

Where the released program and the paper differ, this follows the released program: pixels with any mask count fully and
fall on the nearest texel of a corner-aligned grid, the confidence is divided by its maximum alone, unseen texels stay
black, blocks add attention to the tokens before a separate feed-forward, and features are read at texel centres.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from uika.canonical.surface import SurfaceTexels
from uika.model.checkpoint import CheckpointError, listing
from uika.model.estimator import Estimator
from uika.model.gaussians import CanonicalGaussians
from uika.model.precision import Precision, arithmetic, halve
from uika.model.reconstructor import Reconstructor
from uika.model.released_sizes import SizeError, estimator_config, model_config
from uika.model.view_features import FeatureCache, Keep, content_keys

# Keys that belong to a released file and change no result here, with the reason.
UNUSED = {
    r".*\bmask_token": "stands for hidden patches while the backbone is pretrained",
    r"transformer\.layers\.<last>\.attn2?\.(add_q_proj|norm_added_q)\.\w+": "asks for an update that nobody reads",
    r"renderer\.flame_model\.(shapedirs|posedirs|J_regressor|lbs_weights)_pix": "animation is done by `uika.head`",
    r"renderer\.flame_model\.(v_template|shapedirs|posedirs|J_regressor|parents|lbs_weights)": "the head model itself",
    r"renderer\.flame_model\.(full_lmk_faces_idx|full_lmk_bary_coords|neck_kin_chain)": "landmarks of the head model",
    r"renderer\.flame_model\.(uv_color_flatten|pix_to_face_flatten|faces|verts_uvs|textures_idx)": "for pictures only",
}
_TABLES = "renderer.flame_model."
_PREFIXES = {
    "encoder.": "network.encoder.",
    "transformer.": "network.transformer.",
    "gs_decoder.": "network.gs_decoder.",
}
_ESTIMATOR, _ESTIMATOR_FILE = "uv_wrapper.model.", "fuvt."
_TENSORS_AT_ONCE = 32


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
    texels: tuple[Tensor, Tensor] | None = None,
    strict: bool = True,
) -> ReleasedModel:
    """Read `uika.safetensors`; sizes and texel tables come from the file, weights stay in it until they are used.

    Args:
        path: the file.
        dtype: torch.float32 maps the file into memory; torch.bfloat16 halves the weights while reading.
        estimator: a `fuvt_*.safetensors` file to take the estimator from, instead of the one inside.
        texels: valid texels [M] (int64, row-major) and template points [M,3] for a file without the head's tables.
        strict: False takes no offence at keys that belong to no known part.

    Raises:
        CheckpointError: the file is missing or damaged, or keys are missing, misshapen or unknown; it lists them.
    """
    path = Path(path)
    shapes = _shapes(path)
    tables = _tables(path, shapes, texels)
    inside = {name: shape for name, shape in shapes.items() if not name.startswith(_TABLES)}
    map_size = (
        math.isqrt(shapes[_TABLES + "valid_mask_flatten"][0]) if _TABLES + "valid_mask_flatten" in shapes else None
    )
    if map_size is not None and map_size**2 != shapes[_TABLES + "valid_mask_flatten"][0]:
        raise CheckpointError(f"{path}: {_TABLES}valid_mask_flatten holds no square map")
    try:
        with torch.device("meta"):
            network = Reconstructor(model_config(shapes, map_size))
            own = None if estimator is not None else Estimator(estimator_config(shapes, _ESTIMATOR))
    except SizeError as error:
        raise CheckpointError(f"{path}: {listing('missing or misshapen', error.names)}") from error
    model = ReleasedModel(network, own or load_estimator(estimator or path, dtype=dtype), tables)
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
    model.unused = {name: reason for name in shapes if (reason := _reason(name, last))}
    taken = {old for new, old in names.items() if new in expected}
    if estimator is not None:
        model.unused |= {name: "another file's estimator is used" for name in shapes if name.startswith(_ESTIMATOR)}
    read = {f"{_TABLES}{name}" for name in ("valid_mask_flatten", "v_template_pix", *_BINDING)}
    known = taken | set(model.unused) | read
    strangers = [name for name in shapes if name not in known] if strict else []
    _compare(path, {name: tuple(value.shape) for name, value in expected.items()}, shapes, names, strangers)
    _fill(model, path, {name: names[name] for name in expected}, expected)
    return model.eval()


def load_estimator(path: str | Path, dtype: torch.dtype = torch.float32) -> Estimator:
    """Read the estimator from `fuvt_*.safetensors` (keys `fuvt.*`; the rest of that file is its teacher).

    Raises CheckpointError like `load`.
    """
    path = Path(path)
    shapes = _shapes(path)
    prefix = _ESTIMATOR_FILE if any(name.startswith(_ESTIMATOR_FILE) for name in shapes) else _ESTIMATOR
    try:
        with torch.device("meta"):
            model = Estimator(estimator_config(shapes, prefix))
    except SizeError as error:
        raise CheckpointError(f"{path}: {listing('missing or misshapen', error.names)}") from error
    if dtype == torch.bfloat16:
        halve(model, exempt=(model.uv_head,))
    names = {name.removeprefix(prefix): name for name in shapes if name.startswith(prefix)}
    expected = model.state_dict()
    strangers = [old for new, old in names.items() if new not in expected and not _reason(old, "")]
    _compare(path, {name: tuple(value.shape) for name, value in expected.items()}, shapes, names, strangers)
    _fill(model, path, {name: names[name] for name in expected}, expected)
    return model.eval()


_BINDING = ("pix_to_v_idx_flatten", "pix_bary_flatten")


def _mapped(name: str) -> str | None:
    """This program's name of a released key."""
    if name.startswith(_ESTIMATOR):
        return "estimator." + name.removeprefix(_ESTIMATOR)
    return next((new + name.removeprefix(old) for old, new in _PREFIXES.items() if name.startswith(old)), None)


def _reason(name: str, last: str) -> str | None:
    return next((why for rule, why in UNUSED.items() if re.fullmatch(rule.replace("<last>", last), name)), None)


def _shapes(path: Path) -> dict[str, tuple[int, ...]]:
    if not path.is_file():
        raise CheckpointError(f"{path}: no such model file")
    try:
        with safe_open(path, framework="pt") as file:
            return {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path}: damaged, truncated or no safetensors file ({error})") from error


def _compare(
    path: Path,
    expected: Mapping[str, tuple[int, ...]],
    shapes: Mapping[str, tuple[int, ...]],
    names: Mapping[str, str],
    strangers: list[str],
) -> None:
    missing = [name for name in expected if name not in names]
    wrong = [
        f"{names[name]} {list(shapes[names[name]])} instead of {list(shape)}"
        for name, shape in expected.items()
        if name in names and shapes[names[name]] != shape
    ]
    problems = [
        listing("missing", [_released(name) for name in missing]),
        listing("misshapen", wrong),
        listing("unknown (strict=False ignores these)", strangers),
    ]
    if any(problems):
        raise CheckpointError(f"{path}: {'; '.join(filter(None, problems))}")


def _released(name: str) -> str:
    back = {new: old for old, new in _PREFIXES.items()} | {"estimator.": _ESTIMATOR}
    return next((old + name.removeprefix(new) for new, old in back.items() if name.startswith(new)), name)


def _fill(model: nn.Module, path: Path, names: Mapping[str, str], expected: Mapping[str, Tensor]) -> None:
    """Give the model its tensors: views of the file where all types fit, else copies that do not hold on to it."""
    copy = any(value.dtype == torch.bfloat16 for value in expected.values())
    tensors = {new: tensor.to(expected[new].dtype, copy=copy) for new, tensor in _tensors(path, names)}
    model.load_state_dict(tensors, strict=False, assign=True)
    model.requires_grad_(False)


def _tensors(path: Path, names: Mapping[str, str]) -> Iterator[tuple[str, Tensor]]:
    """(new name, tensor) of each; the file is opened anew now and then, which gives back what was read of it."""
    waiting = list(names.items())
    for first in range(0, len(waiting), _TENSORS_AT_ONCE):
        with safe_open(path, framework="pt") as file:
            for new, old in waiting[first : first + _TENSORS_AT_ONCE]:
                yield new, file.get_tensor(old)


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
    read = dict(_tensors(path, found | {short: name for short, name in optional.items() if name in shapes}))
    texel = read["valid"].bool().nonzero()[:, 0]
    counts = {names.get(short, short): len(value) for short, value in read.items() if short != "valid"}
    if any(count != len(texel) for count in counts.values()):
        raise CheckpointError(f"{path}: {len(texel)} valid texels, but tables of other lengths: {counts}")
    tables = {short: read.get(short) for short in ("corners", "barycentric")}
    return {"texel": texel, "points": read["points"].float().clone(), **tables}
