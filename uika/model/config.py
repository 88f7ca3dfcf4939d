"""Every number of the model in one place; presets differ in values only, never in code paths."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

Scope = Literal["all", "face_colors", "unseen_colors"]
SCOPES: tuple[Scope, ...] = ("all", "face_colors", "unseen_colors")


@dataclass(frozen=True)
class BackboneConfig:
    """The vision transformer that turns an image into patch features at several depths.

    `taps` are 0-based block indices. `frozen` keeps its weights out of training (for a pretrained backbone).
    """

    dim: int
    depth: int
    heads: int
    taps: tuple[int, ...]
    patch_size: int = 16
    storage_tokens: int = 4
    layer_scale: float = 1.0
    frozen: bool = False


@dataclass(frozen=True)
class UvConfig:
    """How photo colours reach the atlas (paper section 3.1); fields are those of `uika.uv`.

    `fill` completes unseen texels (mirror, then diffusion) before the network sees the map; `full_trust` is the mean
    pixel weight from which on an observed colour is kept as it is.
    """

    grid: Literal["centers", "corners"] = "centers"
    normalization: Literal["minmax", "max"] = "minmax"
    oversample: int = 2
    close_radius: int = 2
    fill: bool = True
    full_trust: float = 0.3


@dataclass(frozen=True)
class GaussianConfig:
    """Range and initial value of each Gaussian attribute (paper table S1).

    relative       True: scales and rotations are residuals on the size and frame of the surface texel, so that the
                   untrained model is already a closed surface; False: absolute values as in the paper
    offset_range   metres, offsets lie in +-offset_range
    scale_clip     metres, upper end of every scale
    init_scale     log of the initial scale in metres (absolute) or of its ratio to the texel size (relative)
    fusion_bias    initial logit of the fusion weight where nothing was seen; predicted colours then start as the
                   completed observation. None leaves the colour layer at the default random initialisation
    fusion_trust   how much that logit falls, at the start, as confidence goes from 0 to 1
    least_scale    smallest ratio of a scale to the texel size (relative only): 1 keeps the surface closed
    """

    relative: bool
    offset_range: float = 0.1
    scale_clip: float = 0.01
    init_scale: float = -5.0
    init_opacity: float = 0.1
    fusion_bias: float | None = None
    fusion_trust: float = 0.0
    least_scale: float = 0.0


@dataclass(frozen=True)
class EstimatorConfig:
    """The facial correspondence estimator (paper section 3.1, supplement A.1).

    backbone      its last tap alone is read
    layers        number of pairs of a frame block and a global block, one decoder level each
    heads         attention heads of those blocks
    channels      of the four decoder levels
    features      inner channels of the decoder
    """

    backbone: BackboneConfig
    heads: int
    channels: tuple[int, int, int, int]
    features: int
    layers: int = 4


@dataclass(frozen=True)
class SurfaceEstimatorConfig:
    """The small correspondence estimator (`uika.model.surface_estimator`).

    size     side of the pictures that it sees, pixels; a multiple of 2^(number of widths)
    widths   channels at 1/2, 1/4, ... of that side
    blocks   residual blocks at each of them
    table    side of the atlas whose texels are kept to find UV coordinates
    """

    size: int = 128
    widths: tuple[int, ...] = (16, 32, 64, 128, 192)
    blocks: tuple[int, ...] = (0, 1, 2, 2, 3)
    table: int = 128

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        if len(self.widths) != len(self.blocks) or self.size % 2 ** len(self.widths):
            raise ValueError(f"size must be a multiple of 2^levels, with one width and one count each, not {self}")


@dataclass(frozen=True)
class ModelConfig:
    """Architecture of a `Reconstructor`.

    image_size        side of the photos and reprojected views that the backbone sees (pixels); 0 takes photos as they
                      are, and reprojected views as large as their height
    map_size          side of the aggregate and of the Gaussian attribute maps (texels)
    token_grid        side of the grid of learnable UV tokens
    dim, heads        width and attention heads of the transformer
    layers            number of transformer blocks
    outputs           1-based depths whose tokens go to the decoder, shallow to deep
    dpt_projections   channels of the four decoder levels
    dpt_features      inner channels of the decoder
    mlp_width         inner width of the per-texel MLP
    uv_attention      ablation: False drops the UV branch, tokens attend to screen features only
    aggregation       ablation: False hides the aggregate from the decoder and takes predicted colours alone
    surface           True shows the decoder how far the fitted surface stands off the bald head, which tells hair from
                      skin where no photo does, and off the mean head; not in the paper, whose surface is the same for
                      everybody
    palette           number of colours, each a weighted mean of what the photos show, that a predicted colour may be
                      mixed from; 0 for none; not in the paper
    detail            share of the completed observation's fine relief of colours that predicted colours take over; a
                      network that is trained on mean errors paints smooth; not in the paper
    fusion            "learned" weight per Gaussian, or ablation "fixed": 0.5 times the confidence
    scope             what predictions count for: "all"; "face_colors", the colours of the face alone; or
                      "unseen_colors", with half their weight, those of skin and hair off the face that no photo shows.
                      All else stays the surface with its completed observation, as without a network
    canonical         surface that Gaussians start on and are moved with: "personal", the head with the person's
                      identity and hair, or "template", the mean head, as in the paper, where offsets hold the identity
    """

    name: str
    image_size: int
    map_size: int
    token_grid: int
    backbone: BackboneConfig
    dim: int
    heads: int
    layers: int
    outputs: tuple[int, int, int, int]
    dpt_projections: tuple[int, int, int, int]
    dpt_features: int
    mlp_width: int
    uv: UvConfig
    gaussians: GaussianConfig
    uv_attention: bool = True
    aggregation: bool = True
    surface: bool = False
    palette: int = 0
    detail: float = 0.0
    fusion: Literal["learned", "fixed"] = "learned"
    scope: Scope = "all"
    canonical: Literal["personal", "template"] = "personal"

    def __post_init__(self) -> None:
        """Refuse combinations that cannot be built, naming the field."""
        backbone = self.backbone
        requirements = [
            (self.image_size % backbone.patch_size == 0, "image_size must be a multiple of backbone.patch_size"),
            (backbone.dim % (4 * backbone.heads) == 0, "backbone.dim must be a multiple of 4 * backbone.heads"),
            (bool(backbone.taps), "backbone.taps must name at least one block"),
            (all(0 <= tap < backbone.depth for tap in backbone.taps), "backbone.taps must lie in 0..depth-1"),
            (self.dim % self.heads == 0 and self.dim % 4 == 0, "dim must be a multiple of heads and of 4"),
            (len(self.outputs) == 4 and len(self.dpt_projections) == 4, "outputs and dpt_projections have 4 entries"),
            (all(1 <= depth <= self.layers for depth in self.outputs), "outputs must lie in 1..layers"),
            (max(self.outputs) == self.layers, "the last of outputs must be layers"),
            (self.token_grid % 2 == 0, "token_grid must be even"),
            (self.fusion in ("learned", "fixed"), 'fusion must be "learned" or "fixed"'),
            (self.scope in SCOPES, f"scope must be one of {', '.join(SCOPES)}"),
            (self.canonical in ("personal", "template"), 'canonical must be "personal" or "template"'),
            (0 <= self.palette <= 64, "palette must lie in 0..64"),
            (0 <= self.detail <= 1, "detail must lie in [0,1]"),
            (0 <= self.gaussians.least_scale <= 1, "gaussians.least_scale must lie in [0,1]"),
            (self.uv.full_trust > 0, "uv.full_trust must be positive"),
            (0 < self.gaussians.init_opacity < 1, "gaussians.init_opacity must lie strictly between 0 and 1"),
        ]
        for holds, message in requirements:
            if not holds:
                raise ValueError(f"model config {self.name!r}: {message}")

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dictionary for JSON."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> ModelConfig:
        """Inverse of `to_dict`; raises ValueError naming unknown or missing fields."""
        nested = {"backbone": BackboneConfig, "uv": UvConfig, "gaussians": GaussianConfig}
        fields = _known(ModelConfig, values)
        for name, kind in nested.items():
            fields[name] = _make(kind, fields.get(name, {}))
        return _make(ModelConfig, fields)


def _known(kind: type, values: Mapping[str, Any]) -> dict[str, Any]:
    names = {field.name for field in dataclasses.fields(kind)}
    unknown = sorted(set(values) - names)
    if unknown:
        raise ValueError(f"unknown fields in {kind.__name__}: {', '.join(unknown)}")
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}


def _make(kind: Any, values: Mapping[str, Any]) -> Any:
    try:
        return kind(**_known(kind, values))
    except TypeError as error:
        raise ValueError(f"{kind.__name__}: {error}") from error


_SURFACE = GaussianConfig(relative=True, init_scale=0.0, init_opacity=0.95, fusion_bias=-8.0)

PRESETS: dict[str, ModelConfig] = {
    "tiny": ModelConfig(
        name="tiny",
        image_size=256,
        map_size=384,
        token_grid=16,
        backbone=BackboneConfig(dim=128, depth=4, heads=4, taps=(0, 1, 2, 3), layer_scale=0.1),
        dim=128,
        heads=4,
        layers=4,
        outputs=(1, 2, 3, 4),
        dpt_projections=(48, 64, 96, 96),
        dpt_features=48,
        mlp_width=64,
        uv=UvConfig(),
        gaussians=dataclasses.replace(_SURFACE, least_scale=1.0),
        surface=True,
        palette=8,
        detail=0.7,
    ),
    "base": ModelConfig(
        name="base",
        image_size=512,
        map_size=384,
        token_grid=48,
        backbone=BackboneConfig(dim=384, depth=12, heads=6, taps=(2, 5, 8, 11), frozen=True),
        dim=512,
        heads=8,
        layers=8,
        outputs=(2, 4, 6, 8),
        dpt_projections=(128, 256, 512, 512),
        dpt_features=128,
        mlp_width=256,
        uv=UvConfig(),
        gaussians=_SURFACE,
    ),
    "paper": ModelConfig(
        name="paper",
        image_size=512,
        map_size=384,
        token_grid=96,
        backbone=BackboneConfig(dim=1024, depth=24, heads=16, taps=(4, 11, 17, 23), layer_scale=1e-5, frozen=True),
        dim=1024,
        heads=16,
        layers=12,
        outputs=(3, 6, 9, 12),
        dpt_projections=(256, 512, 1024, 1024),
        dpt_features=256,
        mlp_width=512,
        uv=UvConfig(grid="corners", normalization="max", oversample=1, close_radius=0, fill=False),
        gaussians=GaussianConfig(relative=False),
        canonical="template",
    ),
}

ESTIMATORS: dict[str, EstimatorConfig] = {
    "tiny": EstimatorConfig(
        backbone=BackboneConfig(dim=192, depth=4, heads=6, taps=(3,), layer_scale=0.1),
        heads=6,
        channels=(48, 64, 96, 96),
        features=56,
    ),
    "base": EstimatorConfig(
        backbone=BackboneConfig(dim=384, depth=12, heads=6, taps=(11,), frozen=True),
        heads=6,
        channels=(96, 192, 384, 384),
        features=128,
    ),
    "paper": EstimatorConfig(
        backbone=BackboneConfig(dim=768, depth=12, heads=12, taps=(11,), layer_scale=1e-5, frozen=True),
        heads=12,
        channels=(256, 512, 1024, 1024),
        features=256,
    ),
}
