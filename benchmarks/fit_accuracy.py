"""How exactly the fit recovers a known head from 1, 2, 4 and 8 photos, with and without refinement by colours.

Random people (identity, skin, expression in each photo) are rendered by Mitsuba from random sides; landmarks are the
true ones with 1 px of noise, or found by the face mesh detector (`--detector`). Errors are against the rendered mesh.
`python -m benchmarks.fit_accuracy [--people 50] [--refined 12] [--resume FOLDER]` writes
`benchmarks/results/fit_accuracy.{json,md}`, with `--detector` `fit_accuracy_detector.{json,md}`.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.figures import lines
from benchmarks.harness import markdown, save
from uika.fitting import Fit, LandmarkFit, fit_landmarks, pixel_uv
from uika.fitting.landmark_bias import unbiased
from uika.fitting.refinement import refine_landmark_fit
from uika.head import Camera, HeadModel, HeadParameters, load_head, look_at, pose_vertices, project
from uika.io.files import replacing

SIZE, TEXELS = 384, 384
VIEWS = (1, 2, 4, 8)
YAW, PITCH = 60.0, 15.0
NOISE = 1.0  # pixels
Table = dict[str, dict[str, list[float]]]  # kind of fit and number of photos -> error -> value of each photo


@dataclass(frozen=True)
class Subject:
    """A person in max(VIEWS) photos."""

    truth: HeadParameters
    vertices: Tensor  # [N,V,3]
    cameras: Camera
    landmarks: Tensor  # [N,478,2]
    images: list[Tensor] | None  # [3,S,S] each


def make_subject(head: HeadModel, seed: int, pictures: bool, detector: bool) -> Subject:
    generator = torch.Generator().manual_seed(seed)
    N, K, E = max(VIEWS), len(head.identity_basis), len(head.expression_names)
    active = torch.rand(N, E, generator=generator) < 0.12
    expression = 0.6 * torch.rand(N, E, generator=generator) * active
    expression[:, head.expression_names.index("tongueOut")] = 0
    identity = (0.8 * torch.randn(K, generator=generator)).expand(N, K)
    truth = HeadParameters.zeros(head, N).replace(identity=identity, expression=expression)
    vertices = pose_vertices(head, truth)
    sides = (torch.rand(N, 2, generator=generator) * 2 - 1) * torch.tensor([YAW, PITCH])
    far = 0.8 + 0.6 * torch.rand(N, generator=generator)
    cameras = Camera.stack(
        [
            look_at(float(yaw), float(pitch), float(d), (0.0, -0.01, 0.0), fov_y=22.0 / float(d), size=SIZE)
            for (yaw, pitch), d in zip(sides, far, strict=True)
        ]
    )
    marks = torch.full((N, 478, 2), SIZE / 2)
    marks[:, head.landmark_ids] = project(head.landmarks(vertices), cameras)[0]
    marks = marks + NOISE * torch.randn(marks.shape, generator=generator)
    images = render_photos(head, vertices, cameras, seed) if pictures or detector else None
    if detector and images is not None:
        found = detect(images)
        seen = torch.tensor([n for n, mesh in enumerate(found) if mesh is not None])
        marks = torch.stack([mesh for mesh in found if mesh is not None])
        cameras = Camera(cameras.viewmat[seen], cameras.K[seen], SIZE, SIZE)
        return Subject(truth[seen], vertices[seen], cameras, marks, [images[n] for n in seen.tolist()])
    return Subject(truth, vertices, cameras, marks, images)


def render_photos(head: HeadModel, vertices: Tensor, cameras: Camera, seed: int) -> list[Tensor]:
    from scenes import linear_to_srgb, render
    from scenes.people import paint, sample_person

    texture = linear_to_srgb(paint(sample_person(seed, head), head, 512)[0])
    shots = [render(vertices[n], head, cameras[n], texture, aovs=("rgb",), spp=16)["rgb"] for n in range(len(vertices))]
    return [torch.from_numpy(shot).permute(2, 0, 1).contiguous() for shot in shots]


def detect(images: list[Tensor]) -> list[Tensor | None]:
    """Landmarks [478,2] of each picture, found as `uika.photo` finds them; None where there are none."""
    from uika.photo.detect import find_face

    bytes_ = [(image.permute(1, 2, 0) * 255).round().byte().numpy().copy() for image in images]
    return [None if (mesh := find_face(image)) is None else torch.from_numpy(mesh).float() for image in bytes_]


def errors(head: HeadModel, subject: Subject, found: LandmarkFit) -> dict[str, list[float]]:
    """Vertex error (mm), pose error (degrees) and UV error (texels) of each photo."""
    N = len(found.focal)
    face = head.masks["face"] > 0.5
    params = HeadParameters.zeros(head, N).replace(
        identity=found.identity.float().expand(N, -1), expression=found.expression.float()
    )
    result: dict[str, list[float]] = defaultdict(list)
    for mine, true in zip(pose_vertices(head, params), subject.vertices, strict=False):
        result["vertex"].append(aligned_distance(mine[face], true[face]))
    turned = found.rotation.float() @ subject.cameras.viewmat[:N, :3, :3].mT
    cosine = (turned.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2
    result["pose"] = torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).tolist()
    viewmat = torch.eye(4).repeat(N, 1, 1)
    viewmat[:, :3, :3], viewmat[:, :3, 3] = found.rotation.float(), found.translation.float()
    K = torch.eye(3).repeat(N, 1, 1)
    K[:, 0, 0] = K[:, 1, 1] = found.focal.float()
    K[:, :2, 2] = SIZE / 2
    still, matte = torch.zeros_like(head.template), torch.ones(N, SIZE, SIZE)
    none = torch.zeros(N)
    uv, valid, _ = pixel_uv(Fit(params, Camera(viewmat, K, SIZE, SIZE), still, none), head, matte)
    truth = Fit(subject.truth[:N], Camera(subject.cameras.viewmat[:N], subject.cameras.K[:N], SIZE, SIZE), still, none)
    true_uv, true_valid, _ = pixel_uv(truth, head, matte)
    for n in range(N):
        both = valid[n] & true_valid[n]
        result["uv"].append(float((uv[n] - true_uv[n])[both].norm(dim=-1).median()) * TEXELS)
    return dict(result)


def aligned_distance(points: Tensor, truth: Tensor) -> float:
    """Mean distance in mm after the best similarity: size and distance cannot be told apart."""
    a, b = points - points.mean(0), truth - truth.mean(0)
    u, s, vt = torch.linalg.svd(a.T @ b)
    return float((a @ (u @ vt) * (s.sum() / a.square().sum()) - b).norm(dim=-1).mean()) * 1e3


def measure(head: HeadModel, seed: int, refine: bool, detector: bool) -> Table:
    """Errors of one person, by kind of fit and number of photos."""
    table: Table = {}
    subject = make_subject(head, seed, pictures=refine, detector=detector)
    for N in VIEWS:
        if len(subject.landmarks) < N:
            break
        marks = subject.landmarks[:N]
        found = fit_landmarks(marks, head, SIZE)
        if detector:
            table[f"landmarks as detected {N}"] = errors(head, subject, found)
            marks = unbiased(marks, found, head)
            found = fit_landmarks(marks, head, SIZE)
        table[f"landmarks {N}"] = errors(head, subject, found)
        if refine and N > 1 and subject.images is not None:
            refined, _ = refine_landmark_fit(found, subject.images[:N], marks, head)
            table[f"landmarks of the same people {N}"] = table[f"landmarks {N}"]
            table[f"refined {N}"] = errors(head, subject, refined)
    return table


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=50, help="for the landmark fit")
    parser.add_argument("--refined", type=int, default=12, help="for refinement, which needs Mitsuba's pictures")
    parser.add_argument(
        "--detector", action="store_true", help="landmarks of the face mesh detector, not the true ones"
    )
    parser.add_argument("--resume", type=Path, help="folder that keeps each person's figures for a later run")
    arguments = parser.parse_args(argv)
    head = load_head().without_bust
    tables: list[Table] = []
    for seed in range(arguments.people):
        refine = seed < arguments.refined
        name = f"{'detected' if arguments.detector else 'true'}_{seed}{'_refined' if refine else ''}.json"
        kept = arguments.resume / name if arguments.resume else None
        if kept is None or not kept.exists():
            tables.append(measure(head, seed, refine, arguments.detector))
            if kept is not None:
                kept.parent.mkdir(parents=True, exist_ok=True)
                with replacing(kept) as temporary:
                    temporary.write_text(json.dumps(tables[-1]))
        else:
            tables.append(json.loads(kept.read_text()))
        print(f"person {seed + 1} of {arguments.people}", flush=True)
    write(tables, arguments)


def write(tables: list[Table], arguments: argparse.Namespace) -> None:
    rows = []
    kinds = (
        ["landmarks as detected", "landmarks"]
        + ["landmarks of the same people"] * (arguments.refined < arguments.people)
        + ["refined"]
    )
    for kind in kinds:
        for N in VIEWS:
            people = [table[f"{kind} {N}"] for table in tables if f"{kind} {N}" in table]
            if not people:
                continue
            row: dict[str, object] = {"fit": kind, "views": N, "people": len(people)}
            for name, unit in (("vertex", "mm"), ("pose", "deg"), ("uv", "texels")):
                values = np.concatenate([person[name] for person in people])
                row[f"{name} median {unit}"] = round(float(np.median(values)), 2)
                row[f"{name} p95 {unit}"] = round(float(np.percentile(values, 95)), 2)
            rows.append(row)
    source = f"true + {NOISE:g} px noise"
    if arguments.detector:
        source = "found by the detector, then freed from its bias on turned faces"
    text = (
        f"Landmarks: {source}. {arguments.people} people with another expression in each photo, "
        f"yaw within {YAW:g} and pitch within {PITCH:g} degrees, {SIZE} px. "
        f"Refined: {min(arguments.refined, arguments.people)} of them.\n\n"
    )
    name = "fit_accuracy_detector" if arguments.detector else "fit_accuracy"
    save(name, "Fit accuracy", text + markdown(rows), {"landmarks": source, "rows": rows})
    lines(
        name,
        {
            ("photos", f"{label}, median"): {
                kind: [(float(str(r["views"])), float(str(r[key]))) for r in rows if r["fit"] == kind]
                for kind in dict.fromkeys(str(row["fit"]) for row in rows)
            }
            for label, key in (("vertices, mm", "vertex median mm"), ("pose, degrees", "pose median deg"))
        },
    )


if __name__ == "__main__":
    main()
