"""What a training needs before its first step, and what it says about itself then."""

from __future__ import annotations

from pathlib import Path

from torch import nn

from uika.errors import UikaError
from uika.head import HeadModel
from uika.io.weights import sha256
from uika.model import ESTIMATORS, BackboneConfig, Reconstructor
from uika.model.backbone import VisionTransformer
from uika.model.dinov3 import KNOWN, check_backbone
from uika.train.config import TrainConfig

_DIGITS = 12  # of a file's digest, enough to tell files apart


def backbone_config(config: TrainConfig) -> BackboneConfig:
    """The backbone of the network that a training trains."""
    return ESTIMATORS[config.preset].backbone if config.part == "estimator" else config.finished.backbone


def needs(config: TrainConfig) -> str:
    """What a preset cannot do without, as a phrase; empty for nothing."""
    backbone = backbone_config(config)
    if not backbone.frozen:
        return ""
    size = (backbone.depth, backbone.dim, backbone.patch_size)
    name = KNOWN.get(size, f"a backbone of {size[0]} blocks and {size[1]} channels")
    return f"the weights of {name}, which stay as they are"


def check_start(config: TrainConfig, backbone: Path | None, has_weights: bool) -> None:
    """Refuse a training that lacks what its preset needs.

    Args:
        config: the training.
        backbone: weights given for the backbone.
        has_weights: whether the network's weights come from a model file or a checkpoint, the backbone's among them.

    Raises:
        UikaError: a frozen backbone would stay random, or a file is given for one that is trained.
        CheckpointError: the file is no backbone of the preset's size.
    """
    if backbone is not None:
        if not needs(config):
            raise UikaError(
                f"--backbone {backbone}: preset '{config.preset}' trains its small backbone from scratch; leave it out"
            )
        check_backbone(backbone, backbone_config(config))
    elif needs(config) and not has_weights:
        raise UikaError(
            f"preset '{config.preset}' needs {needs(config)}: give the file with --backbone (`uika weights` says where "
            "to get it), or a trained model with --init"
        )


def summary(config: TrainConfig, model: nn.Module, head: HeadModel, files: dict[str, Path | None]) -> list[str]:
    """Lines on what is trained, with which files."""
    counts = {True: 0, False: 0}
    for parameter in model.parameters():
        counts[parameter.requires_grad] += parameter.numel()
    lines = [
        f"preset {config.preset}, {config.part}: {counts[True] / 1e6:.1f} M trained weights, "
        f"{counts[False] / 1e6:.1f} M frozen",
        f"head model '{head.id}', {len(head.template):,} vertices",
    ]
    for name, path in files.items():
        if path is not None:
            lines.append(f"{name}: {path} (sha256 {file_digest(path)})")
    if config.part == "reconstructor":
        lines.append("correspondence: " + _correspondence(config, files.get("estimator")))
        if files.get("lpips") is None and config.losses.lpips:
            lines.append("perceptual loss: image gradients stand in for LPIPS, whose weights --lpips takes")
    return lines


def file_digest(path: Path) -> str:
    """The first digits of a file's SHA-256."""
    return sha256(path)[:_DIGITS]


def backbone_of(model: nn.Module) -> VisionTransformer:
    """The backbone of either network."""
    found = model.encoder.model if isinstance(model, Reconstructor) else model.aggregator.patch_embed  # type: ignore[union-attr]
    assert isinstance(found, VisionTransformer)
    return found


def _correspondence(config: TrainConfig, estimator: Path | None) -> str:
    if estimator is not None:
        return "of the estimator"
    fitted = "photos as in use" if config.photographed else "landmarks with errors"
    return f"exact, and fitted to {fitted} for {config.fitted:.0%} of the heads"
