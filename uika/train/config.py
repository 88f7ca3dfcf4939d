"""Every number of a training in one place; presets differ in values only."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal

from uika.errors import UikaError
from uika.model import PRESETS, ModelConfig
from uika.model.config import Scope

Part = Literal["reconstructor", "estimator"]


@dataclass(frozen=True)
class LossWeights:
    """Weights of the losses; a weight of 0 leaves the term out.

    Defaults are the paper's (section 3.4) with the gradient loss in the place of LPIPS, which takes over when its
    weights are given.
    """

    l1: float = 1.0
    ssim: float = 0.1
    lpips: float = 1.0
    gradient: float = 1.0
    offset: float = 0.1
    entropy: float = 0.0
    alpha: float = 0.1
    atlas: float = 0.0  # of colours against the true ones of the atlas, where data with exact correspondence has them
    atlas_seen: float = 1.0  # share of that weight which texels have that the photos show
    change: float = 0.0  # of colours off what the photos show of a texel
    relief: float = 0.0  # of positions in metres against the true surface
    variation: float = 0.001  # of the estimator's maps


@dataclass(frozen=True)
class TrainConfig:
    """How to train one network of one preset."""

    preset: str = "tiny"
    architecture: ModelConfig | None = None  # of the reconstructor in the place of the preset's, for ablations
    scope: Scope = "all"  # what the preset's predictions count for
    part: Part = "reconstructor"
    # First logit of the fusion weight where nothing was seen, and its fall with confidence: untrained presets keep the
    # weight so low that predicted colours would not learn.
    fusion_bias: float = 1.0
    fusion_trust: float = 12.0
    least_scale: float | None = None  # in training, on an atlas coarser than in use; None for the preset's own
    steps: int = 20000
    seed: int = 0
    # Data
    sources: int = 4  # N_ref, most photos per head
    targets: int = 3  # N_d, pictures per head to compare with
    images: int = 4  # photos per process and step, shared by its heads
    items: int = 2  # most heads per process and step
    size: int = 256  # pixels of photos and pictures
    texels: int = 0  # side of the atlas in training, which may be coarser than in use; 0 for the preset's
    atlas_views: int = 0  # more pictures per head that only tell the atlas's true colours
    own: int = 0  # most photos of a head whose own views, with the cameras in use, are among the pictures
    fitted: float = 0.5  # share of heads whose correspondence comes from a fit
    photographed: bool = False  # fit photos as in use: detector, mattes, refinement; else known landmarks with errors
    # What pictures show of the person: what masks say, or what splats of the true surface, which must be known, cover.
    outline: Literal["mask", "splats"] = "mask"
    facing: float = 0.25  # least cosine between face and camera of a photo; -1 takes every view
    backgrounds: tuple[float, ...] = (0.0, 0.5, 1.0, 1.0)  # grey levels behind photos; in use they are white
    estimator: str = ""  # digest of the file whose estimator finds the correspondence of photos; empty for none
    variants: int = 2  # items of each person and number of photos where they are prepared and kept
    augment: bool = True  # what cameras, files and hands do to photos, and crops
    # Optimiser
    optimizer: Literal["adamw", "adam"] = "adamw"
    learning_rate: float = 4e-4
    warmup: int = 500
    betas: tuple[float, float] = (0.9, 0.95)
    weight_decay: float = 0.05
    clip: float = 1.0  # largest norm of the gradient
    ema: float = 0.999  # share of the running mean of the weights that stays in a step; 0 for none
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    checkpointing: bool = False  # recompute activations instead of keeping them
    losses: LossWeights = field(default_factory=LossWeights)
    # Keeping
    save_every: int = 250
    keep: int = 2  # checkpoints
    histogram_every: int = 250
    patience: int = 10  # steps in a row that may be skipped for values that are not finite

    def __post_init__(self) -> None:
        """Refuse values that cannot work, naming the field."""
        if self.preset not in PRESETS:
            raise UikaError(f"preset must be one of {', '.join(PRESETS)}, not '{self.preset}'")
        for name in ("steps", "sources", "targets", "images", "items", "variants", "save_every", "keep", "patience"):
            if getattr(self, name) < 1:
                raise UikaError(f"{name} must be at least 1, not {getattr(self, name)}")
        if min(self.texels, self.atlas_views, self.own) < 0:
            raise UikaError("texels, atlas_views and own must not be negative")
        if self.size < 32 or self.size % 16:
            raise UikaError(f"size must be a multiple of 16 and at least 32 pixels, not {self.size}")
        for name in ("fitted", "ema"):
            if not 0 <= getattr(self, name) <= 1:
                raise UikaError(f"{name} must lie in [0,1], not {getattr(self, name)}")
        if not self.backgrounds or not all(0 <= level <= 1 for level in self.backgrounds):
            raise UikaError(f"backgrounds must be grey levels in [0,1], not {self.backgrounds}")
        if not -1 <= self.facing <= 1:
            raise UikaError(f"facing must lie in [-1,1], not {self.facing}")
        if self.learning_rate <= 0 or self.clip <= 0 or self.warmup < 0 or self.seed < 0:
            raise UikaError("learning_rate and clip must be positive, warmup and seed not negative")

    @property
    def model(self) -> ModelConfig:
        """Architecture of the reconstructor in training: the fusion weight's start, the atlas's side, no detail."""
        config = dataclasses.replace(self.finished, map_size=self.texels or self.finished.map_size, detail=0.0)
        if self.least_scale is not None:
            start = dataclasses.replace(config.gaussians, least_scale=self.least_scale)
            config = dataclasses.replace(config, gaussians=start)
        start = config.gaussians
        if start.fusion_bias is None or start.fusion_bias >= self.fusion_bias:
            return config
        start = dataclasses.replace(start, fusion_bias=self.fusion_bias, fusion_trust=self.fusion_trust)
        return dataclasses.replace(config, gaussians=start)

    @property
    def finished(self) -> ModelConfig:
        """Architecture of the reconstructor in use; no weight depends on the side of the atlas."""
        preset = dataclasses.replace(PRESETS[self.preset], scope=self.scope)
        return preset if self.architecture is None else self.architecture

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dictionary for JSON."""
        return dataclasses.asdict(self)


_LARGE = {"sources": 16, "targets": 8, "images": 16, "items": 8, "size": 512, "warmup": 3000, "checkpointing": True}

TRAINING: dict[str, TrainConfig] = {
    "tiny": TrainConfig(
        steps=4000,
        scope="unseen_colors",
        sources=3,
        targets=1,
        own=1,
        images=3,
        items=3,
        size=128,
        fitted=0.7,
        photographed=True,
        outline="splats",
        backgrounds=(1.0,),
        texels=192,
        least_scale=0.75,
        atlas_views=4,
        learning_rate=2e-3,
        warmup=50,
        precision="float32",
        losses=LossWeights(alpha=1.0, atlas=1.0, atlas_seen=0.1, change=0.5, relief=15.0),
    ),
    "base": TrainConfig(preset="base", steps=100_000, **_LARGE),  # type: ignore[arg-type]
    # The paper's recipe as printed; docs/paper.md has a row for each value.
    "paper": TrainConfig(
        preset="paper",
        steps=150_000,
        fitted=0.0,
        facing=-1.0,
        backgrounds=(0.0, 0.5, 1.0),
        augment=False,
        optimizer="adam",
        weight_decay=0.0,
        ema=0.0,
        losses=LossWeights(alpha=0.0),
        **_LARGE,  # type: ignore[arg-type]
    ),
}
