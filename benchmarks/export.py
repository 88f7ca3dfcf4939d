"""Every export format read back: errors of the values and of the picture, and sizes.

Run `python -m benchmarks.export AVATAR.safetensors`; writes `benchmarks/results/export.{json,md}`. The page's rows
need Chromium.
"""

from __future__ import annotations

import argparse
import base64
import io
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import Tensor

from benchmarks.harness import markdown, save
from drjit_splat import load_ply, load_spz, rasterization, save_ply
from tests.chromium import page
from tests.drjit_splat.common import random_scene
from uika import Avatar, Camera, HeadModel, Motion, get_motion, load_head, neutral_camera
from uika import export as files
from uika.export import Splats
from uika.export.ply import triangle_frames
from uika.head import pose_gaussians
from uika.metrics import psnr

SIZE, FRAME = 512, 30
COUNT = 2000  # Gaussians with harmonics
Written = Callable[[Path, "Case"], Splats]


@dataclass(frozen=True)
class Case:
    """An avatar in a pose."""

    avatar: Avatar
    head: HeadModel
    motion: Motion
    splats: Splats  # posed, Y up


def from_ply(path: Path) -> Splats:
    file = load_ply(path)
    return Splats(file.means, file.quats, file.scales, file.opacities, file.colors)


def ply(path: Path, case: Case) -> Splats:
    files.write_ply(path, case.splats.half_turned())
    return from_ply(path).half_turned()


def spz(path: Path, case: Case) -> Splats:
    files.write_spz(path, case.splats)
    file = load_spz(path)
    return Splats(file.means, file.quats, file.scales, file.opacities, file.colors).turned_over()


def splat(path: Path, case: Case) -> Splats:
    """The file is sorted by size; brought back to the avatar's order by the nearest mean."""
    files.write_splat(path, case.splats.half_turned())
    found = files.read_splat(path).half_turned()
    order = (case.splats.scales.prod(-1) * case.splats.opacities).argsort(descending=True, stable=True)
    back = torch.empty_like(order)
    back[order] = torch.arange(len(order))
    return Splats(*(getattr(found, name)[back] for name in ("means", "quats", "scales", "opacities", "colors")))


def glb(path: Path, case: Case) -> Splats:
    files.write_glb(path, case.splats)
    return files.read_glb(path)


def npz(path: Path, case: Case) -> Splats:
    files.write_npz(path, case.avatar, case.head, case.motion)
    with np.load(path, allow_pickle=False) as file:
        t = {
            name: torch.from_numpy(file[name])
            for name in file.files
            if file[name].dtype.kind in "fi" and file[name].ndim
        }
    binding = (t["faces"], t["triangle"], t["barycentric"])
    moved = pose_gaussians(t["means"], t["quats"], t["scales"], t["vertices"], t["frames"][FRAME], *binding)
    return Splats(*moved, t["opacities"], t["colors"])


def bound(path: Path, case: Case) -> Splats:
    """Relative to the triangles; put together in the neutral pose."""
    files.write_bound_ply(path, case.avatar, case.head)
    local, triangle = from_ply(path), case.avatar.triangle
    centre, turn, size = triangle_frames(case.avatar.canonical_vertices(case.head), case.head.faces)
    length = size[triangle][:, None]
    means = (turn[triangle] @ (local.means * length)[..., None])[..., 0] + centre[triangle]
    frames = Rotation.from_matrix(turn[triangle].double().numpy())
    turns = frames * Rotation.from_quat(local.quats.double().numpy(), scalar_first=True)
    quats = torch.from_numpy(turns.as_quat(scalar_first=True)).float()
    return Splats(means, quats, local.scales * length, local.opacities, local.colors)


def picture(splats: Splats, camera: Camera) -> Tensor:
    colors, _, _ = rasterization(
        *(splats.means, splats.quats, splats.scales, splats.opacities, splats.colors),
        camera.viewmat[None],
        camera.K[None],
        SIZE,
        SIZE,
        backgrounds=torch.ones(1, 3),
    )
    return colors[0].clamp(0, 1)


def row(name: str, write: Written, case: Case, truth: Splats, folder: Path) -> dict[str, object]:
    """One format: largest errors of the values, and of the picture."""
    path = folder / f"a.{name.split()[0].strip('.')}"
    found = write(path, case)
    camera = neutral_camera(case.avatar, 25.0, 10.0, SIZE)
    pictures = picture(found, camera), picture(truth, camera)
    quats = (torch.nn.functional.normalize(s.quats.double(), dim=-1) for s in (found, truth))
    one, other = quats
    cosine = (one * other).sum(-1).abs().clamp(max=1)
    return {
        "format": name,
        "mean, mm": f"{1e3 * float((found.means - truth.means).norm(dim=-1).max()):.1e}",
        "turn, degrees": f"{float(torch.rad2deg(2 * torch.arccos(cosine)).max()):.2g}",
        "scale, relative": f"{float((found.scales / truth.scales - 1).abs().max()):.1e}",
        "opacity": f"{float((found.opacities - truth.opacities).abs().max()):.1e}",
        "colour": f"{float((found.colors - truth.colors).abs().max()):.1e}",
        **errors(*pictures),
        "bytes": path.stat().st_size,
        "bytes a Gaussian": round(path.stat().st_size / len(truth), 1),
    }


def errors(one: Tensor, other: Tensor) -> dict[str, object]:
    found = psnr(one, other)
    return {
        "PSNR, dB": ">= 120" if found >= 120 else round(found, 1),
        "pixel": f"{float((one - other).abs().max()):.4f}",
    }


def html(case: Case, folder: Path) -> list[dict[str, object]]:
    """The page in a browser, against the rasterizer, at two frames."""
    path = folder / "a.html"
    size = files.write_html(path, case.avatar, case.motion, case.head)
    rows = []
    with page(folder) as tab:
        tab.open(path.as_uri())
        tab.wait("!!window.avatar")
        for frame in (0, FRAME):
            url = tab.run(f"avatar.show({SIZE}, {SIZE}, {{frame: {frame}, yaw: 25, pitch: 10}})")
            shown = np.array(Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB"))
            params = case.motion.parameters(case.avatar.identity)[frame]
            truth = picture(
                files.posed_splats(case.avatar, case.head, params), neutral_camera(case.avatar, 25.0, 10.0, SIZE)
            )
            blank = dict.fromkeys(("mean, mm", "turn, degrees", "scale, relative", "opacity", "colour"), "")
            row = {"format": f".html, frame {frame}", **blank, **errors(torch.from_numpy(shown) / 255, truth)}
            rows.append({**row, "bytes": size, "bytes a Gaussian": round(size / len(case.avatar), 1)})
    return rows


def harmonics(folder: Path) -> list[dict[str, object]]:
    """3DGS files of every degree, written and read."""
    rows = []
    for degree in range(4):
        scene = random_scene(COUNT, seed=degree)
        generator = torch.Generator().manual_seed(degree)
        scene["colors"] = 0.3 * torch.randn(COUNT, (degree + 1) ** 2, 3, generator=generator)
        names = ("means", "quats", "scales", "opacities", "colors")
        path = folder / f"degree{degree}.ply"
        save_ply(path, *(scene[name] for name in names))
        file = load_ply(path)
        values = (file.means, file.quats, file.scales, file.opacities, file.harmonics)
        read = {**scene, **dict(zip(names, values, strict=True))}
        before, after = (rasterization(**one, width=64, height=64, sh_degree=degree)[0][0] for one in (scene, read))
        rows.append(
            {
                "degree": file.degree,
                "coefficient": f"{float((file.harmonics - scene['colors']).abs().max()):.1e}",
                "scale, relative": f"{float((file.scales / scene['scales'] - 1).abs().max()):.1e}",
                "opacity": f"{float((file.opacities - scene['opacities']).abs().max()):.1e}",
                **errors(after, before),
                "bytes a Gaussian": round(path.stat().st_size / COUNT, 1),
            }
        )
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    """Measure all formats."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("avatar", type=Path)
    avatar, head = Avatar.load(parser.parse_args(argv).avatar), load_head()
    motion = get_motion("talk", head)
    posed = files.posed_splats(avatar, head, motion.parameters(avatar.identity)[FRAME])
    case = Case(avatar, head, motion, posed)
    formats: dict[str, Written] = {".ply": ply, ".glb": glb, ".npz with a motion": npz, ".splat": splat, ".spz": spz}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        rows = [row(name, write, case, posed, folder) for name, write in formats.items()]
        rows.append(row(".ply with binding, neutral", bound, case, files.posed_splats(avatar, head), folder))
        rows += html(case, folder)
        degrees = harmonics(folder)
    lines = (
        f"{len(avatar):,} Gaussians in frame {FRAME} of the built-in talk, {SIZE}x{SIZE} pixels. Errors: the largest",
        "of any Gaussian or pixel (0 to 1); the page's are against the rasterizer.",
        "",
        markdown(rows),
        "",
        f"3DGS files with harmonics, {COUNT:,} random Gaussians:",
        "",
        markdown(degrees),
    )
    text = "\n".join(lines)
    save("export", "Export", text, {"rows": rows, "degrees": degrees})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
