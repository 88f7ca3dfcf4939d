"""Agreement between a splatted head and Mitsuba's render of its mesh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch


@dataclass(frozen=True)
class SplatReport:
    """How well splats cover the mesh and how far in front of or behind it they lie."""

    mask_iou: float  # intersection over union of the two masks
    depth_median: float  # metres, median of |splat depth - mesh depth| where both see the head
    depth_p95: float  # metres, its 95th percentile
    pixels: int  # compared pixels


def compare_splats(
    alpha: torch.Tensor | np.ndarray,
    depth: torch.Tensor | np.ndarray,
    reference: Mapping[str, np.ndarray],
    threshold: float = 0.5,
) -> SplatReport:
    """Compare rendered splats with `scenes.render` images of the same view.

    Args:
        alpha: [H,W] or [H,W,1] splat opacity.
        depth: [H,W] or [H,W,1] expected splat depth, metres of camera z.
        reference: images "mask" and "depth" from `scenes.render`.
        threshold: opacity from which a pixel counts as covered, in both.

    Raises:
        ValueError: the reference lacks an image or the sizes differ.
    """
    if missing := {"mask", "depth"} - set(reference):
        raise ValueError(f"the reference lacks {sorted(missing)}; render with aovs=('mask', 'depth')")
    mask, mesh_depth = reference["mask"], reference["depth"]
    splat_alpha, splat_depth = (_plane(image, mask.shape, name) for image, name in ((alpha, "alpha"), (depth, "depth")))
    covered, expected = splat_alpha >= threshold, mask >= threshold
    union = int((covered | expected).sum())
    both = covered & expected & (mesh_depth > 0)
    error = np.abs(splat_depth[both] - mesh_depth[both]) if both.any() else np.array([np.nan])
    iou = float((covered & expected).sum() / union) if union else 1.0
    return SplatReport(iou, float(np.median(error)), float(np.percentile(error, 95)), int(both.sum()))


def _plane(image: torch.Tensor | np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    array = image.detach().cpu().numpy() if isinstance(image, torch.Tensor) else np.asarray(image)
    array = array[..., 0] if array.ndim == 3 and array.shape[-1] == 1 else array
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}; the reference images are {shape}")
    return array
