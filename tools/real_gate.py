"""What a change gained and lost on real photos, person by person, against figures kept from before.

    python -m tools.real_gate FOLDER [--kept figures.json] [--output figures.json] [--model tiny] [--no-photo-splats]

Every photo in FOLDER is a person of one photo, every folder in it a person of several. Each person's avatar is
rendered at its photos' own cameras: PSNR in dB inside the matte of head and hair (`head`), inside the face's oval
(`face`) and in the rest (`hair`), the overlap of silhouette and person (`iou`), and the mean distance of detected
landmarks in % of that of the outer eye corners (`landmarks`); in the wider crop that shows the shoulders, down to
where the bust fades out, PSNR inside the person's matte (`person`) and the overlap (`person_iou`). Only figures are
written, under the first digits of the photos' hashes: whoever is shown need not have agreed to more. Exit status 1
if a mean has become worse by more than its tolerance, or somebody is refused who was not.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from uika.avatar import Avatar
from uika.avatar.rendering import render
from uika.errors import UikaError
from uika.head import Camera, HeadModel, HeadParameters, load_head, pose_vertices, project
from uika.head.bust import FADE, cut_rim
from uika.io.files import replacing
from uika.photo import head_matte
from uika.photo.networks import face_meshes
from uika.photo.outline import OVAL, polygon
from uika.photo.preparation import BustCrop
from uika.reconstruction import Reconstruction, reconstruct
from uika.reconstruction.bust import wider_camera

Figures = dict[str, float]
SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".heic"}
# Name -> which direction is better, and how far a mean may fall behind before the gate closes.
MEASURES = {"head": (1, 0.1), "face": (1, 0.1), "hair": (1, 0.1), "iou": (1, 0.002), "landmarks": (-1, 0.05)} | {
    "person": (1, 0.1),
    "person_iou": (1, 0.002),
}
LEFT_CORNER, RIGHT_CORNER = 33, 263  # of the eyes, in the face mesh
FEWEST = 200  # pixels that say something


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, compare, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kept", type=Path, help="figures of an earlier run")
    parser.add_argument("--output", type=Path, help="where to write the figures")
    parser.add_argument("--model", default="tiny")
    parser.add_argument("--photo-splats", action=argparse.BooleanOptionalAction, default=True)
    arguments = parser.parse_args(argv)
    try:
        kept = {} if arguments.kept is None else read(arguments.kept)
        found = {}
        for name, photos in people(arguments.folder).items():
            found[name] = measure(photos, arguments.model, photo_splats=arguments.photo_splats)
            print(name, _line(found[name], kept.get(name)), flush=True)
    except UikaError as error:
        print(error, file=sys.stderr)
        return 2
    if arguments.output is not None:
        with replacing(arguments.output) as file:
            file.write_text(json.dumps(found, indent=1) + "\n")
    lost = verdict(found, kept) if kept else []
    print("mean", _line(means(found), means({name: kept[name] for name in found if name in kept}) or None))
    for sentence in lost:
        print(sentence)
    return 1 if lost else 0


def people(folder: Path) -> dict[str, list[Path]]:
    """The people in a folder: names made of their photos' hashes, and the photos.

    Raises:
        UikaError: there is no such folder, or nobody in it.
    """
    if not folder.is_dir():
        raise UikaError(f"{folder}: no such folder; give one with photos")
    groups = [[path] for path in sorted(folder.iterdir()) if path.suffix.lower() in SUFFIXES]
    for inner in sorted(path for path in folder.iterdir() if path.is_dir()):
        photos = sorted(path for path in inner.iterdir() if path.suffix.lower() in SUFFIXES)
        groups += [photos] if photos else []
    if not groups:
        raise UikaError(f"{folder}: holds no photos ({', '.join(sorted(SUFFIXES))})")
    return {_digest(photos): photos for photos in groups}


def measure(photos: Sequence[Path], model: str, *, photo_splats: bool = True) -> Figures:
    """Mean figures of one person over the photos; empty if the photos are refused."""
    try:
        result = reconstruct(photos, model=model, photo_splats=photo_splats)
    except UikaError as error:
        print(f"refused: {error}", file=sys.stderr)
        return {}
    each = [_photo_figures(result, index) for index in range(len(result.photos))]
    return {name: float(np.mean(values)) for name in MEASURES if (values := [one[name] for one in each if name in one])}


def verdict(found: Mapping[str, Figures], kept: Mapping[str, Figures]) -> list[str]:
    """One sentence for each mean that became worse beyond its tolerance and for each person newly refused."""
    both = [name for name in found if found[name] and kept.get(name)]
    now, before = means({name: found[name] for name in both}), means({name: kept[name] for name in both})
    lost = [
        f"{name}: the mean of {len(both)} people went from {before[name]:.3f} to {now[name]:.3f}"
        for name, (sign, tolerance) in MEASURES.items()
        if name in now and name in before and sign * (before[name] - now[name]) > tolerance
    ]
    return lost + [f"{name}: is refused and was not" for name in found if not found[name] and kept.get(name)]


def means(rows: Mapping[str, Figures]) -> Figures:
    """Means over people, of those who have a figure."""
    return {
        name: float(np.mean(values))
        for name in MEASURES
        if (values := [figures[name] for figures in rows.values() if name in figures])
    }


def read(path: Path) -> dict[str, Figures]:
    """Figures written by an earlier run.

    Raises:
        UikaError: the file is missing or of another kind.
    """
    try:
        rows = json.loads(path.read_text())
        return {
            name: {measure: float(figures[measure]) for measure in MEASURES if measure in figures}
            for name, figures in rows.items()
        }
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise UikaError(f"{path}: cannot be read as figures of an earlier run ({error})") from error


def _photo_figures(result: Reconstruction, index: int) -> Figures:
    photo, fit = result.photos[index], result.fit
    assert fit is not None
    shown = render(result.avatar, fit.parameters[index], fit.cameras[index], load_head())
    image, rgb = photo.image.permute(1, 2, 0), shown.rgb.clamp(0, 1)
    head = head_matte(photo) > 0.5
    oval = torch.from_numpy(polygon(photo.landmarks.double().numpy()[list(OVAL)], len(head)))
    regions = {"head": head, "face": head & oval, "hair": head & ~oval}
    error = (image - rgb).square().mean(-1)
    figures = {
        name: float(-10 * error[mask].mean().clamp_min(1e-12).log10())
        for name, mask in regions.items()
        if int(mask.sum()) >= FEWEST
    }
    person, covered = photo.matte > 0.5, shown.alpha > 0.5
    figures["iou"] = float((person & covered).sum() / (person | covered).sum().clamp_min(1))
    figures |= (
        {}
        if photo.bust is None
        else portrait_figures(
            result.avatar, load_head(), fit.parameters[index], wider_camera(fit.cameras[index], photo), photo.bust
        )
    )
    distance = _landmark_percent(rgb, photo.landmarks)
    return figures if distance is None else {**figures, "landmarks": distance}


def portrait_figures(avatar: Avatar, head: HeadModel, pose: HeadParameters, camera: Camera, crop: BustCrop) -> Figures:
    """`person` and `person_iou` of an avatar with a bust in a wider crop, at its camera and in its pose."""
    shown = render(avatar, pose, camera, head)
    vertices = pose_vertices(head, pose.replace(identity=avatar.identity), avatar.static_offset)
    rim, depth = project(vertices[cut_rim(head.template)], camera)
    end = rim[:, 1].median() - FADE[1] * camera.K[1, 1] / depth.median()
    shows = (crop.inside > 0.99) & (torch.arange(camera.height) + 0.5 < end)[:, None]
    person, covered = (crop.matte > 0.5) & shows, (shown.alpha > 0.5) & shows
    error = (crop.image.permute(1, 2, 0) - shown.rgb.clamp(0, 1)).square().mean(-1)[person].mean()
    overlap = (person & covered).sum() / (person | covered).sum().clamp_min(1)
    return {"person": float(-10 * error.clamp_min(1e-12).log10()), "person_iou": float(overlap)}


def _landmark_percent(rgb: Tensor, landmarks: Tensor) -> float | None:
    marks = face_meshes([(rgb.numpy() * 255).round().astype(np.uint8)])[0]
    if marks is None:
        return None
    between = (landmarks[LEFT_CORNER] - landmarks[RIGHT_CORNER]).norm()
    return float((torch.from_numpy(marks).float() - landmarks).norm(dim=-1).mean() / between) * 100


def _digest(photos: Sequence[Path]) -> str:
    return hashlib.sha256(b"".join(sorted(hashlib.sha256(path.read_bytes()).digest() for path in photos))).hexdigest()[
        :8
    ]


def _line(figures: Figures, kept: Figures | None) -> str:
    if not figures:
        return "refused"
    parts = []
    for name, value in figures.items():
        change = f" ({value - kept[name]:+.3f})" if kept and name in kept else ""
        parts.append(f"{name} {value:.3f}{change}")
    return "  ".join(parts)


if __name__ == "__main__":
    sys.exit(main())
