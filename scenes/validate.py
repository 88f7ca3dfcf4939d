"""Splats against Mitsuba: `python -m scenes.validate -o report/` compares poses, views and gradients."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from scenes.colour import srgb_to_linear
from scenes.compare import compare_splats
from scenes.gradients import GradientReport, compare_gradients
from scenes.render import render
from uika.head import Camera, HeadModel, HeadParameters, load_head, look_at, pose_gaussians, pose_vertices

SIZE, TEXELS, SPP = 512, 512, 4
VIEWS = ((0.0, 0.0), (45.0, 10.0), (-80.0, -10.0))  # yaw and pitch in degrees
POSES = 12
_TARGET = (0.0, -0.01, -0.03)
# What a view must reach: at least for the first and the last, at most for the others.
LIMITS = {"mask_iou": 0.97, "depth_mm": 1.0, "normal_degrees": 15.0, "uv": 0.004, "psnr": 26.0}
_AT_LEAST = ("mask_iou", "psnr")


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

    def failures(self) -> list[str]:
        """Names of the figures beyond their limits."""
        return [
            name
            for name, limit in LIMITS.items()
            if not (getattr(self, name) >= limit if name in _AT_LEAST else getattr(self, name) <= limit)
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


def validate(
    head: HeadModel, pose_count: int = POSES, views: Sequence[tuple[float, float]] = VIEWS
) -> tuple[list[ViewReport], GradientReport, Pictures]:
    """Compare views and gradients of one head model; the pictures show splats, Mitsuba and their difference."""
    reports, pictures = [], []
    params = poses(head, pose_count)
    for pose in range(pose_count):
        for view, (yaw, pitch) in enumerate(views):
            camera = look_at(yaw, pitch, 0.85, _TARGET, size=SIZE)
            report, picture = _compare_view(head, params[pose], camera, pose, view)
            reports.append(report)
            pictures.append((f"{head.id}: pose {pose}, view {view}", picture))
    return reports, compare_gradients(head), pictures


def texture(size: int = 512) -> Tensor:
    """A colourful smooth sRGB map [3,S,S] with some detail."""
    v, u = torch.meshgrid(*[(torch.arange(size) + 0.5) / size] * 2, indexing="ij")
    waves = [0.5 + 0.35 * torch.sin(2 * torch.pi * (a * u + b * v)) for a, b in ((5, 1), (2, -4), (-3, 6))]
    return torch.stack(waves)


def splat_head(
    head: HeadModel, params: HeadParameters, channels: Tensor, camera: Camera
) -> tuple[Tensor, Tensor, Tensor]:
    """Splat a head's closed surface.

    Args:
        head: the head model.
        params: one frame.
        channels: [D,S,S] UV map of what to splat.
        camera: one camera.

    Returns:
        The channels [H,W,D] divided by the coverage, the coverage [H,W] and the expected depth [H,W].
    """
    from drjit_splat import rasterization
    from uika.surface import surface_texels

    surface, binding = surface_texels(head, params.identity.detach(), torch.zeros_like(head.template), TEXELS)
    rest = HeadParameters.zeros(head).replace(identity=params.identity)
    means, quats, scales = pose_gaussians(
        surface.points[0],
        surface.quats[0],
        surface.scales[0],
        pose_vertices(head, rest),
        pose_vertices(head, params),
        head.faces,
        binding.triangle,
        binding.barycentric,
    )
    values = torch.nn.functional.interpolate(channels[None], (TEXELS, TEXELS), mode="bilinear", antialias=True)[0]
    image, alpha, _ = rasterization(
        means,
        quats,
        scales,
        torch.full((len(means),), 0.95),
        binding.from_map(values).contiguous(),
        camera.viewmat[None],
        camera.K[None],
        camera.width,
        camera.height,
        render_mode="RGB+ED",
    )
    coverage = alpha[0, ..., 0]
    return image[0, ..., :-1] / coverage.clamp_min(1e-6)[..., None], coverage, image[0, ..., -1]


def _compare_view(
    head: HeadModel, params: HeadParameters, camera: Camera, pose: int, view: int
) -> tuple[ViewReport, np.ndarray]:
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
    uv_error = np.linalg.norm(image[..., 3:5].numpy() - reference["uv"], axis=-1)[both]
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the validation; 0 when every figure is within its limits, 1 otherwise."""
    from scenes.report import write_report

    parser = argparse.ArgumentParser(prog="python -m scenes.validate", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the report")
    parser.add_argument("--head", type=Path, action="append", default=[], help="another head file to compare as well")
    parser.add_argument("--quick", action="store_true", help="two poses instead of twelve")
    options = parser.parse_args(arguments)
    heads = [load_head(), *(load_head(path) for path in options.head)]
    results = [validate(head, 2 if options.quick else POSES) for head in heads]
    passed = write_report(options.output, results)
    for reports, gradients, _ in results:
        for field in fields(ViewReport)[3:]:
            values = [getattr(report, field.name) for report in reports]
            median, worst = np.median(values), _worst(field.name, values)
            print(f"{reports[0].head} {field.name}: median {median:.4g}, worst {worst:.4g}")
        print(f"{reports[0].head} gradients: cosine {gradients.cosine:.4f}, ratios {gradients.ratios}")
    print("passed" if passed else "failed", options.output / "index.html")
    return 0 if passed else 1


def _worst(name: str, values: list[float]) -> float:
    return min(values) if name in _AT_LEAST else max(values)


if __name__ == "__main__":
    sys.exit(main())
