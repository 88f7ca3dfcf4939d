"""Time and memory traffic of posing 130,000 Gaussians, and what turning them with the surface is worth.

Run `python -m benchmarks.posing`; writes `benchmarks/results/posing.{json,md,png}`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence

import drjit as dr
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from benchmarks.harness import RESULTS, markdown, save
from tests.avatars import surface_avatar
from uika.avatar import Avatar
from uika.avatar.rig import Rig
from uika.canonical.surface import SurfaceTexels
from uika.head import Binding, HeadModel, HeadParameters, load_head, look_at, pose_gaussians, pose_vertices, uv_texels
from uika.head.binding import rigid_turn
from uika.motion.presets import expression_vector

COUNT = 130_000
ATLAS = 416  # texels; a few more than COUNT of them are covered


def textured_avatar(head: HeadModel, size: int) -> tuple[Avatar, np.ndarray]:
    """A bald avatar with the skin of a synthetic person, and that skin as a texture."""
    from scenes import linear_to_srgb
    from scenes.people import paint, sample_person

    texture = linear_to_srgb(paint(sample_person(3, head), head, 1024)[0])

    def skin(_: SurfaceTexels, binding: Binding) -> torch.Tensor:
        cell = (binding.uv * len(texture)).long().clamp(max=len(texture) - 1)
        return torch.from_numpy(texture)[cell[:, 1], cell[:, 0]].float().clamp(0, 1)

    return surface_avatar(head, size, skin), texture


def fastest(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Least and median seconds."""
    for _ in range(5):
        work()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return min(seconds), float(np.median(seconds))


def bandwidth(repeats: int) -> float:
    """Bytes per second that a large copy reads and writes."""
    source = torch.zeros(1 << 25)
    target = torch.empty_like(source)
    least, _ = fastest(lambda: target.copy_(source), repeats)
    return 2 * 4 * len(source) / least


def timing(head: HeadModel, repeats: int) -> dict[str, object]:
    binding = uv_texels(head, ATLAS)
    pick = torch.linspace(0, len(binding) - 1, COUNT).long()
    triangle, mix = binding.triangle[pick], binding.barycentric[pick]
    rest = HeadParameters.zeros(head)
    moving = rest.replace(expression=expression_vector(head, {"jawOpen": 0.5}), neck=torch.tensor([0.1, 0.3, 0.0]))
    canonical, posed = head.template, pose_vertices(head, moving)
    means = (canonical[head.faces[triangle]] * mix[..., None]).sum(1)
    quats, scales = torch.nn.functional.normalize(torch.randn(COUNT, 4), dim=-1), torch.full((COUNT, 3), 1e-3)
    rig = Rig.of(means, quats, scales, canonical, head.faces, triangle, mix)
    turn = rigid_turn(canonical, posed)

    def kernels() -> None:
        rig.pose(posed, turn)
        dr.sync_thread()

    with torch.no_grad():
        fused = fastest(kernels, repeats)
        gaussians = fastest(
            lambda: pose_gaussians(means, quats, scales, canonical, posed, head.faces, triangle, mix), repeats
        )
        vertices = fastest(lambda: pose_vertices(head, moving), repeats)
    inputs = 4 * (dr.width(rig.records) + dr.width(rig.rest) + dr.width(rig.corners) + 8 * len(canonical))
    outputs = sum(t.numel() * t.element_size() for t in (means, quats, scales))
    speed = bandwidth(repeats)
    return {
        "gaussians": COUNT,
        "threads": torch.get_num_threads(),
        "kernels (`Rig.pose`) ms least": round(fused[0] * 1e3, 2),
        "kernels (`Rig.pose`) ms median": round(fused[1] * 1e3, 2),
        "torch (`pose_gaussians`) ms least": round(gaussians[0] * 1e3, 2),
        "torch (`pose_gaussians`) ms median": round(gaussians[1] * 1e3, 2),
        "pose_vertices ms least": round(vertices[0] * 1e3, 2),
        "megabytes in and out of the kernels": round((inputs + outputs) / 1e6, 1),
        "memory gigabytes per second": round(speed / 1e9, 1),
        "ms at memory speed": round((inputs + outputs) / speed * 1e3, 2),
    }


def skinning(head: HeadModel) -> tuple[dict[str, object], Image.Image]:
    """A turned, jaw-open head by both skinnings, against Mitsuba's unlit picture of the mesh."""
    from drjit_splat import rasterization
    from scenes import render

    avatar, texture = textured_avatar(head, ATLAS)
    params = HeadParameters.zeros(head).replace(
        rotation=torch.tensor([0.0, 0.9, 0.0]), expression=expression_vector(head, {"jawOpen": 0.9})
    )
    camera = look_at(0.0, 0.0, 0.9, (0.0, -0.02, 0.02), fov_y=18.0, size=512)
    vertices = pose_vertices(head, params)
    shot = render(vertices, head, camera, texture, aovs=("rgb", "mask"), spp=64, light="flat")
    truth, mask = torch.from_numpy(shot["rgb"]), torch.from_numpy(shot["mask"]) > 0.99
    figures: dict[str, object] = {}
    tiles: list[Tensor] = [truth]
    for name in ("surface", "released"):
        means, quats, scales = avatar.pose(params, head, skinning=name)  # type: ignore[arg-type]
        colors, _, _ = rasterization(
            means, quats, scales, avatar.opacities, avatar.colors, camera.viewmat[None], camera.K[None], 512, 512,
            backgrounds=torch.ones(1, 3),
        )  # fmt: skip
        picture = colors[0].clamp(0, 1)
        error = (picture - truth)[mask].square().mean()
        figures[f"psnr {name} dB"] = round(float(-10 * torch.log10(error)), 2)
        tiles += [picture, ((picture - truth).abs() * 4).clamp(0, 1)]
    return figures, Image.fromarray((torch.cat(tiles, 1) * 255).byte().numpy())


def main(argv: Sequence[str] | None = None) -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=60)
    arguments = parser.parse_args(argv)
    torch.set_num_threads(2)
    head = load_head().without_bust
    figures = timing(head, arguments.repeats)
    worth, picture = skinning(head)
    figures.update(worth)
    RESULTS.mkdir(parents=True, exist_ok=True)
    picture.save(RESULTS / "posing.png")
    text = markdown([{"figure": name, "value": value} for name, value in figures.items()])
    text += "\n\nPicture: Mitsuba; turned with the surface and its error x4; released skinning and its error x4."
    save("posing", "Posing Gaussians", text, {"figures": figures})


if __name__ == "__main__":
    main()
