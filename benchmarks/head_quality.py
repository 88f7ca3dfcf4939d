"""How good a reconstruction is: `python -m benchmarks.head_quality [-o FOLDER]` prints a table and saves a picture.

On the bundled portrait: colour error in the face, silhouette, landmarks, each at the photo's own camera. On renders of
a known head: splats against Mitsuba's mesh, and avatars from one, two and four photos, in any order.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from benchmarks.harness import RESULTS, machine
from scenes import compare_splats
from scenes import render as render_mesh
from uika.assets import PORTRAIT
from uika.avatar import Avatar
from uika.avatar.rendering import render
from uika.fitting.landmarks import EYE_CORNERS
from uika.head import (
    Camera,
    HeadModel,
    HeadParameters,
    load_head,
    look_at,
    pose_vertices,
    project,
    rasterize,
    uv_texels,
)
from uika.metrics import mask_iou, psnr
from uika.reconstruction import Reconstruction, reconstruct

VIEWS = (0.0, 35.0, -35.0, 15.0)  # yaw of the synthetic photos, degrees
MAP_SIZE = 384  # side of the atlas the built-in model decodes


@dataclass(frozen=True)
class PortraitFigures:
    """Agreement of an avatar with its own photo, at the photo's camera and expression."""

    face_psnr: float  # dB inside the skin of the face
    silhouette_iou: float  # splat alpha against the person's matte
    landmark_percent: float  # mean landmark distance in percent of the distance of the outer eye corners
    gaussians: int


@dataclass(frozen=True)
class MeshFigures:
    """Splats of an avatar against Mitsuba's render of the mesh they are bound to."""

    pose: str
    mask_iou: float
    depth_median_mm: float


def face_mask(head: HeadModel, vertices: Tensor, camera: Camera) -> Tensor:
    """Pixels [H,W] that show the skin of the face."""
    points, depth = project(vertices, camera)
    triangle, mix = rasterize(points, head.faces, camera.height, camera.width, depth=depth)
    share = (head.masks["face"][head.faces[triangle.clamp(min=0)]] * mix).sum(-1)
    return (triangle >= 0) & (share > 0.5)


def portrait_figures(result: Reconstruction, head: HeadModel, photo: int = 0) -> tuple[PortraitFigures, Tensor]:
    """Figures of one source photo, and the render [H,W,3] they were taken on."""
    avatar, fit, source = result.avatar, result.fit, result.photos[photo]
    params, camera = fit.parameters[photo], fit.cameras[photo]
    vertices = pose_vertices(head, params, fit.static_offset)
    picture = render(avatar, params, camera, head)
    image = source.image.permute(1, 2, 0)
    marks = source.landmarks[head.landmark_ids]
    corners = source.landmarks[list(EYE_CORNERS)]
    distance = (project(head.landmarks(vertices), camera)[0] - marks).norm(dim=-1).mean()
    figures = PortraitFigures(
        face_psnr=psnr(picture.rgb, image, face_mask(head, vertices, camera)),
        silhouette_iou=mask_iou(picture.alpha, source.matte),
        landmark_percent=float(100 * distance / (corners[0] - corners[1]).norm()),
        gaussians=len(avatar.means),
    )
    return figures, picture.rgb


def mesh_figures(avatar: Avatar, head: HeadModel) -> list[MeshFigures]:
    """Three poses of the avatar: turned, mouth open with the neck bent, smiling from above."""

    def acting(**weights: float) -> Tensor:
        expression = torch.zeros(len(head.expression_names))
        for name, weight in weights.items():
            expression[head.expression_names.index(name)] = weight
        return expression

    rest = HeadParameters.zeros(head).replace(identity=avatar.identity)
    poses = {
        "turned by 40°": (rest, look_at(40.0, 0.0, 1.2, fov_y=20.0, size=512)),
        "mouth open, neck bent": (
            rest.replace(expression=acting(jawOpen=0.6), neck=torch.tensor([0.15, -0.3, 0.05])),
            look_at(0.0, 0.0, 1.2, fov_y=20.0, size=512),
        ),
        "smiling, from above": (
            rest.replace(expression=acting(mouthSmileLeft=0.8, mouthSmileRight=0.8, eyeBlinkLeft=1.0)),
            look_at(-30.0, 20.0, 1.2, fov_y=20.0, size=512),
        ),
    }
    figures = []
    for name, (params, camera) in poses.items():
        picture = render(avatar, params, camera, head, depth=True)
        assert picture.depth is not None
        vertices = pose_vertices(head, params, avatar.static_offset)
        reference = render_mesh(vertices, head, camera, aovs=("mask", "depth"))
        report = compare_splats(picture.alpha, picture.depth, reference)
        figures.append(MeshFigures(name, report.mask_iou, 1e3 * report.depth_median))
    return figures


@dataclass(frozen=True)
class PhotosFigures:
    """Avatars from renders of a known head."""

    photos: int
    seen_psnr: float  # dB over the head at the first photo's camera
    novel_psnr: float  # dB over the head, mean of two views no photo shows
    order_change: float  # largest change of any Gaussian's value when the photos come in reverse order


NOVEL = (-55.0, 50.0)


def photograph(avatar: Avatar, head: HeadModel, yaw: float, spp: int = 64) -> tuple[Tensor, Tensor, Camera]:
    """Mitsuba's picture [H,W,3] and mask [H,W] of the avatar's textured mesh, with the camera."""
    binding = uv_texels(head, MAP_SIZE)
    texture = binding.to_map(avatar.colors, fill=0.5)
    params = HeadParameters.zeros(head).replace(identity=avatar.identity)
    vertices = pose_vertices(head, params, avatar.static_offset)
    camera = look_at(yaw, 3.0, 1.3, fov_y=24.0, size=640)
    images = render_mesh(vertices, head, camera, texture, ("rgb", "mask"), spp, background=(0.55, 0.6, 0.65))
    return torch.from_numpy(images["rgb"]), torch.from_numpy(images["mask"]), camera


def photos_figures(truth: Avatar, head: HeadModel, counts: Sequence[int] = (1, 2, 4)) -> list[PhotosFigures]:
    """Photograph a known head, reconstruct it from some of the photos and compare with the head."""
    figures = []
    with tempfile.TemporaryDirectory() as folder:
        paths = []
        for yaw in VIEWS[: max(counts)]:
            path = Path(folder) / f"view{yaw:+.0f}.png"
            Image.fromarray((photograph(truth, head, yaw)[0].numpy() * 255).round().astype(np.uint8)).save(path)
            paths.append(path)
        for count in counts:
            result = reconstruct(paths[:count], head, photo_splats=False)
            back = reconstruct(paths[:count][::-1], head, photo_splats=False)
            figures.append(
                PhotosFigures(
                    photos=count,
                    seen_psnr=_shared_view_psnr(result, truth, head, VIEWS[0]),
                    novel_psnr=sum(_shared_view_psnr(result, truth, head, yaw) for yaw in NOVEL) / len(NOVEL),
                    order_change=_largest_change(result.avatar, back.avatar),
                )
            )
    return figures


def _shared_view_psnr(result: Reconstruction, truth: Avatar, head: HeadModel, yaw: float) -> float:
    """Compare at a view of the truth: the avatar is placed there by the similarity between the two heads' faces."""
    reference, mask, camera = photograph(truth, head, yaw)
    scale, turn, shift = _alignment(result.avatar, truth, head)
    viewmat = camera.viewmat.clone()
    viewmat[:3, :3] = scale * camera.viewmat[:3, :3] @ turn
    viewmat[:3, 3] = camera.viewmat[:3, :3] @ shift + camera.viewmat[:3, 3]
    # A camera cannot scale: dividing the whole matrix by the scale leaves the picture as it is.
    viewmat[:3] /= scale
    params = HeadParameters.zeros(head).replace(identity=result.avatar.identity)
    placed = Camera(viewmat, camera.K, camera.width, camera.height)
    picture = render(result.avatar, params, placed, head, background=(0.55, 0.6, 0.65))
    return psnr(picture.rgb, reference, mask > 0.5)


def _alignment(avatar: Avatar, truth: Avatar, head: HeadModel) -> tuple[float, Tensor, Tensor]:
    """Scale, rotation [3,3] and shift [3] that carry the avatar's neutral face onto the truth's."""
    face = head.masks["face"] > 0.5

    def neutral(one: Avatar) -> Tensor:
        return pose_vertices(head, HeadParameters.zeros(head).replace(identity=one.identity), one.static_offset)[face]

    a, b = neutral(avatar), neutral(truth)
    u, s, vt = torch.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    turn = u @ vt
    scale = float(s.sum() / (a - a.mean(0)).square().sum())
    return scale, turn, b.mean(0) - scale * turn @ a.mean(0)


def _largest_change(first: Avatar, second: Avatar) -> float:
    turned = torch.where((first.quats * second.quats).sum(-1, keepdim=True) < 0, -second.quats, second.quats)
    fields = ("means", "scales", "opacities", "colors")
    changes = [getattr(first, name) - getattr(second, name) for name in fields]
    return max(float(change.abs().max()) for change in (first.quats - turned, *changes))


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    parser.add_argument("--photos", type=int, nargs="+", default=[1, 2, 4], help="of the known head, up to 4")
    arguments = parser.parse_args(argv)
    arguments.output.mkdir(parents=True, exist_ok=True)
    head = load_head().without_bust
    result = reconstruct([PORTRAIT], head)
    portrait, picture = portrait_figures(result, head)
    surface = reconstruct([PORTRAIT], head, photo_splats=False).avatar  # Mitsuba knows the mesh alone
    mesh = mesh_figures(surface, head)
    photos = photos_figures(surface, head, arguments.photos)
    source = result.photos[0].image.permute(1, 2, 0)
    error = (picture - source).abs().mean(-1, keepdim=True).mul(4).clamp(0, 1).expand(-1, -1, 3)
    strip = (torch.cat((source, picture, error), 1).clamp(0, 1) * 255).round().to(torch.uint8)
    Image.fromarray(strip.numpy()).save(arguments.output / "head_quality.png")
    figures = {
        "machine": machine(),
        "portrait": asdict(portrait),
        "mesh": [asdict(f) for f in mesh],
        "photos": [asdict(f) for f in photos],
    }
    (arguments.output / "head_quality.json").write_text(json.dumps(figures, indent=2, ensure_ascii=False) + "\n")
    (arguments.output / "head_quality.md").write_text(table := _markdown(portrait, mesh, photos))
    print(table)


def _markdown(portrait: PortraitFigures, mesh: list[MeshFigures], photos: list[PhotosFigures]) -> str:
    lines = [
        "| portrait, at its own camera | |",
        "|---|---|",
        f"| PSNR inside the face | {portrait.face_psnr:.2f} dB |",
        f"| silhouette against the person's matte (IoU) | {portrait.silhouette_iou:.3f} |",
        f"| landmarks, mean, of the distance of the outer eye corners | {portrait.landmark_percent:.2f} % |",
        f"| Gaussians | {portrait.gaussians:,} |",
        "",
        "| splats against Mitsuba's mesh | mask IoU | median depth error |",
        "|---|---|---|",
        *(f"| {f.pose} | {f.mask_iou:.3f} | {f.depth_median_mm:.2f} mm |" for f in mesh),
        "",
        "| photos of a known head | PSNR at a photo's view | PSNR at unseen views (±50°) | change by photo order |",
        "|---|---|---|---|",
        *(f"| {f.photos} | {f.seen_psnr:.2f} dB | {f.novel_psnr:.2f} dB | {f.order_change:.1e} |" for f in photos),
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
