"""Views of splats compared with Mitsuba's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from scenes.colour import srgb_to_linear
from scenes.reference_render import render
from scenes.validation.compare import compare_splats
from scenes.validation.splat_head import TEXELS, splat_head, texture
from uika.head import Camera, HeadModel, HeadParameters, pose_vertices

SIZE, SPP = 512, 4
VIEWS = ((0.0, 0.0), (45.0, 10.0), (-80.0, -10.0))  # yaw and pitch in degrees
POSES = 12
HEAD_VIEW = (0.85, (0.0, -0.01, -0.03))  # metres from what the camera looks at
BUST_VIEW = (1.65, (0.0, -0.09, -0.04))
# What a view must reach: at least for the first and the last, at most for the others.
LIMITS = {"mask_iou": 0.97, "depth_mm": 1.0, "normal_degrees": 15.0, "uv": 0.004, "psnr": 26.0}
# From twice the distance a pixel covers twice as much, and the bust's open lower end shows its inside.
BUST_LIMITS = {"mask_iou": 0.96, "depth_mm": 2.0, "normal_degrees": 15.0, "uv": 0.004, "psnr": 24.0}
AT_LEAST = ("mask_iou", "psnr")


@dataclass(frozen=True)
class ViewReport:
    """Agreement of one view."""

    head: str
    pose: int
    view: int
    mask_iou: float
    depth_mm: float  # median of the absolute difference, millimetres
    normal_degrees: float  # median angle between normals from splat depth and those of the mesh
    uv: float  # median distance of the correspondences, in widths of the atlas
    psnr: float  # decibels, flat light, where both see the head
    bust: bool = False  # whether the head has one, and is looked at from farther away

    @property
    def limits(self) -> dict[str, float]:
        """What each figure has to reach, by name."""
        return BUST_LIMITS if self.bust else LIMITS

    def failures(self) -> list[str]:
        """Names of the figures beyond their limits."""
        return [
            name
            for name, limit in self.limits.items()
            if not (getattr(self, name) >= limit if name in AT_LEAST else getattr(self, name) <= limit)
        ]


Pictures = list[tuple[str, np.ndarray]]


def poses(head: HeadModel, count: int, seed: int = 0) -> HeadParameters:
    """Parameters [T] of different people in different poses; the first is the mean head at rest."""
    generator = torch.Generator().manual_seed(seed)
    strength = torch.ones(count, 1)
    strength[0] = 0

    def draw(size: int, scale: float) -> Tensor:
        return strength * scale * torch.randn(count, size, generator=generator)

    zero = HeadParameters.zeros(head, count)
    jaw = torch.zeros(count, 3)
    jaw[:, 0] = strength[:, 0] * 0.25 * torch.rand(count, generator=generator)
    return zero.replace(
        identity=draw(zero.identity.shape[1], 0.7),
        expression=draw(zero.expression.shape[1], 0.25).abs().clamp_max(0.8),
        rotation=draw(3, 0.15),
        neck=draw(3, 0.1),
        jaw=jaw,
        eyes=draw(6, 0.1),
    )


def compare_view(
    head: HeadModel, params: HeadParameters, camera: Camera, pose: int, view: int
) -> tuple[ViewReport, np.ndarray]:
    """Compare one view; the picture [H,3W,3] shows splats, Mitsuba and their difference, in linear colour."""
    paint = texture()
    names = ("linear", "mask", "depth", "normal", "uv")
    vertices = pose_vertices(head, params)
    reference = render(vertices, head, camera, paint, names, SPP, "flat")
    v, u = torch.meshgrid(*[(torch.arange(TEXELS) + 0.5) / TEXELS] * 2, indexing="ij")
    linear = torch.from_numpy(srgb_to_linear(paint.numpy()))
    small = torch.nn.functional.interpolate(linear[None], (TEXELS, TEXELS), mode="bilinear")[0]
    image, alpha, depth = splat_head(head, params, torch.cat((small, torch.stack((u, v)))), camera)
    coverage = compare_splats(alpha, depth, reference)
    both = (alpha.numpy() > 0.95) & (reference["mask"] > 0.99) & (reference["depth"] > 0)
    in_tile = np.where(reference["uv"] > 1, reference["uv"] - [1.0, 0.0], reference["uv"])
    uv_error = np.linalg.norm(image[..., 3:5].numpy() - in_tile, axis=-1)[both]
    colour_error = (np.clip(image[..., :3].numpy(), 0, 1) - reference["linear"])[both]
    normals = depth_normals(depth.numpy(), camera)
    cosine = np.abs((normals * reference["normal"]).sum(-1))[both]
    report = ViewReport(
        head.id,
        pose,
        view,
        coverage.mask_iou,
        1000 * coverage.depth_median,
        float(np.degrees(np.arccos(np.clip(np.nanmedian(cosine), 0, 1)))),
        float(np.median(uv_error)),
        float(-10 * np.log10(max(float(np.mean(colour_error**2)), 1e-12))),
        head.bust is not None,
    )
    shown = image[..., :3].numpy() * alpha.numpy()[..., None]
    return report, np.concatenate((shown, reference["linear"], np.abs(shown - reference["linear"])), 1)


def depth_normals(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """World-space unit normals [H,W,3] of a depth image [H,W], by central differences; NaN at its border."""
    height, width = depth.shape
    K = camera.K.double().numpy()
    y, x = np.mgrid[:height, :width] + 0.5
    rays = np.stack(((x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)), -1)
    points = rays * depth[..., None]
    result = np.full((height, width, 3), np.nan)
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    normal = np.cross(across, down)
    result[1:-1, 1:-1] = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    return result @ camera.viewmat[:3, :3].double().numpy()
