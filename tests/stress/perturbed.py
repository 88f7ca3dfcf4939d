"""The demo portrait, spoiled 200 times: `python -m tests.stress.perturbed [--prepare-only]`.

Each spoiled photo goes through all of `uika.reconstruct`, or its first stage, which finds the landmarks. It must be
refused, or the landmarks found in it and those of the avatar's head must lie where the untouched portrait's are carried
by the same change, within 3 % of its height. `--rows FILE` keeps what is done, so that a second call goes on;
`--short` leaves out shoulders, network and photo splats, which come after the landmarks and the fit and move neither.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFilter

from uika import reconstruct
from uika.assets import PORTRAIT
from uika.head import load_head, pose_vertices, project
from uika.photo import PhotoError, prepare

LIMIT = 0.03  # of the face's height, mean over the landmarks
Points = NDArray[np.float64]


@dataclass(frozen=True)
class Spoiled:
    """A picture, how points of the portrait are carried into it (matrix [2,3]), and whether sides are swapped."""

    image: Image.Image
    matrix: NDArray[np.float64]
    mirrored: bool = False


@dataclass(frozen=True)
class Row:
    """What became of one spoiled photo; errors in face heights, of the landmarks found and of the avatar's head."""

    kind: str
    number: int
    amount: str
    refused: str = ""
    error: float | None = None
    avatar: float | None = None

    @property
    def right(self) -> bool:
        """Whether it was refused, or everything lies within the limit."""
        return bool(self.refused) or max(self.error or 0.0, self.avatar or 0.0) < LIMIT


def _warp(image: Image.Image, matrix: NDArray[np.float64], size: tuple[int, int]) -> Image.Image:
    back = np.linalg.inv(np.vstack((matrix, (0, 0, 1))))[:2]
    return image.transform(size, Image.Transform.AFFINE, back.ravel(), Image.Resampling.BICUBIC, fillcolor=(128,) * 3)


def _still(image: Image.Image) -> Spoiled:
    return Spoiled(image, np.eye(2, 3))


def turned(image: Image.Image, face: Points, rng: np.random.Generator) -> tuple[Spoiled, str]:
    """Turned by any angle on a canvas that holds it all."""
    angle = rng.uniform(-180, 180)
    a = np.deg2rad(angle)
    turn = np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
    size = np.ceil(np.abs(turn) @ image.size).astype(int)
    shift = size / 2 - turn @ (np.array(image.size) / 2)
    matrix = np.column_stack((turn, shift))
    return Spoiled(_warp(image, matrix, tuple(size.tolist())), matrix), f"{angle:.0f} degrees"


def scaled(image: Image.Image, face: Points, rng: np.random.Generator) -> tuple[Spoiled, str]:
    """Resized by 0.15 to 4, each axis a little differently."""
    scale = np.exp(rng.uniform(np.log(0.15), np.log(4)))
    sides = np.round(np.array(image.size) * scale * rng.uniform(0.92, 1.08, 2)).astype(int)
    other = image.resize(tuple(sides.tolist()), Image.Resampling.LANCZOS)
    return Spoiled(other, np.column_stack((np.diag(sides / image.size), (0, 0)))), f"{scale:.2f} times"


def cropped(image: Image.Image, face: Points, rng: np.random.Generator) -> tuple[Spoiled, str]:
    """Cut on one side so that up to half of the face is lost, or closely around it."""
    low, high = face.min(0), face.max(0)
    box = np.array([*(low - rng.uniform(0.1, 1) * (high - low)), *(high + rng.uniform(0.1, 1) * (high - low))])
    side, cut = int(rng.integers(4)), rng.uniform(-0.3, 0.5)
    extent = (high - low)[side % 2]
    box[side] = low[side % 2] + cut * extent if side < 2 else high[side % 2] - cut * extent
    box = box.clip(0, np.tile(image.size, 2)).round()
    matrix = np.column_stack((np.eye(2), -box[:2]))
    scale = max(1.0, 160 / (box[2:] - box[:2]).min())  # keeps small cuts above the smallest size that is read
    size = tuple(np.round((box[2:] - box[:2]) * scale).astype(int).tolist())
    part = image.crop(tuple(box.astype(int).tolist())).resize(size, Image.Resampling.BICUBIC)
    return Spoiled(part, scale * matrix), f"{max(cut, 0):.0%} of the face cut off, side {side}"


def blurred(image: Image.Image, face: Points, rng: np.random.Generator) -> tuple[Spoiled, str]:
    """Gaussian blur of up to 12 % of the face's height."""
    sigma = float(rng.uniform(0, 0.12) * np.ptp(face[:, 1]))
    return _still(image.filter(ImageFilter.GaussianBlur(sigma))), f"{sigma:.1f} px"


def noisy(image: Image.Image, face: Points, rng: np.random.Generator) -> tuple[Spoiled, str]:
    """Gaussian noise of up to 120 levels."""
    level = rng.uniform(0, 120)
    values = np.asarray(image) + rng.normal(0, level, (*image.size[::-1], 3))
    return _still(Image.fromarray(values.clip(0, 255).astype(np.uint8))), f"{level:.0f} levels"


def compressed(image: Image.Image, face: Points, rng: np.random.Generator) -> tuple[Spoiled, str]:
    """JPEG of quality 1 to 30, on a picture of half the size or more."""
    quality, file = int(rng.integers(1, 31)), io.BytesIO()
    image.save(file, "JPEG", quality=quality)
    return _still(Image.open(file).convert("RGB")), f"quality {quality}"


def exposed(image: Image.Image, face: Points, rng: np.random.Generator) -> tuple[Spoiled, str]:
    """A gamma of 0.15 to 7."""
    gamma = np.exp(rng.uniform(np.log(0.15), np.log(7)))
    return _still(image.point(lambda value: round(255 * (value / 255) ** gamma))), f"gamma {gamma:.2f}"


def mirrored(image: Image.Image, face: Points, rng: np.random.Generator) -> tuple[Spoiled, str]:
    """Left and right exchanged, and turned."""
    flip = np.array([[-1.0, 0, image.width], [0, 1, 0]])
    other, text = turned(_warp(image, flip, image.size), face, rng)
    matrix = np.column_stack((other.matrix[:, :2] @ flip[:, :2], other.matrix @ [image.width, 0, 1]))
    return Spoiled(other.image, matrix, True), text


def covered(image: Image.Image, face: Points, rng: np.random.Generator) -> tuple[Spoiled, str]:
    """A grey card over one side of the face, up to 70 % of it."""
    low, high = face.min(0), face.max(0)
    share, side = rng.uniform(0, 0.7), int(rng.integers(4))
    box = np.array([*(low - 0.3 * (high - low)), *(high + 0.3 * (high - low))])
    at = side % 2
    box[(side + 2) % 4] = low[at] + share * (high - low)[at] if side < 2 else high[at] - share * (high - low)[at]
    other = image.copy()
    other.paste((90, 90, 90), tuple(box.round().astype(int).tolist()))
    return _still(other), f"{share:.0%}, side {side}"


def mixed(image: Image.Image, face: Points, rng: np.random.Generator) -> tuple[Spoiled, str]:
    """Turned, and three of the changes of colour."""
    first, text = turned(image, face, rng)
    other, texts = first.image, [text]
    for change in rng.permutation(np.array([blurred, noisy, compressed, exposed], dtype=object))[:3]:
        spoiled, text = change(other, face, rng)
        other = spoiled.image
        texts.append(text)
    return Spoiled(other, first.matrix), ", ".join(texts)


KINDS: dict[str, Callable[[Image.Image, Points, np.random.Generator], tuple[Spoiled, str]]] = {
    each.__name__: each
    for each in (turned, scaled, cropped, blurred, noisy, compressed, exposed, mirrored, covered, mixed)
}


def portrait() -> tuple[Image.Image, Points]:
    """The portrait and its landmarks [478,2] in pixels."""
    photo = prepare(PORTRAIT, 512)
    x0, y0, side = photo.crop
    return Image.open(PORTRAIT).convert("RGB"), photo.landmarks.double().numpy() * side / 512 + (x0, y0)


def mirror_pairs() -> NDArray[np.int64]:
    """Landmark -> the one on the face's other side, from the head model's symmetric face."""
    head = load_head()
    places, ids = head.landmarks(head.template).numpy(), head.landmark_ids.numpy()
    pairs = np.arange(478)
    for index, place in zip(ids, places, strict=True):
        pairs[index] = ids[np.linalg.norm(places - place * (-1, 1, 1), axis=1).argmin()]
    return pairs


def try_one(
    kind: str,
    number: int,
    image: Image.Image,
    face: Points,
    folder: Path,
    prepare_only: bool = False,
    short: bool = False,
) -> Row:
    """Spoil the portrait, reconstruct from it or only prepare it, and compare."""
    rng = np.random.default_rng([number, *kind.encode()])
    spoiled, amount = KINDS[kind](image, face, rng)
    path = folder / f"{kind}{number}.png"
    spoiled.image.save(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            head = load_head().without_bust
            less: dict[str, Any] = {"head": head, "model": "none", "photo_splats": False} if short else {}
            made = None if prepare_only else reconstruct([path], **less)
            photo = prepare(path) if made is None else made.photos[0]
    except PhotoError as error:
        return Row(kind, number, amount, str(error).partition(": ")[2])
    x0, y0, side = photo.crop
    truth = face[mirror_pairs()] if spoiled.mirrored else face
    want = truth @ spoiled.matrix[:, :2].T + spoiled.matrix[:, 2]
    height = np.sqrt(abs(np.linalg.det(spoiled.matrix[:, :2]))) * np.ptp(face[:, 1])

    def error(marks: Points, goal: Points) -> float:
        found = marks * side / photo.image.shape[-1] + (x0, y0)
        return float(np.linalg.norm(found - goal, axis=1).mean() / height)

    avatar = None
    if made is not None:
        assert made.fit is not None
        placed = head.landmarks(pose_vertices(head, made.fit.parameters[0], made.fit.static_offset))
        shown = project(placed, made.fit.cameras[0])[0].double().numpy()
        avatar = error(shown, want[head.landmark_ids.numpy()])
    return Row(kind, number, amount, error=error(photo.landmarks.double().numpy(), want), avatar=avatar)


def table(rows: list[Row]) -> str:
    """Photos, refusals and errors by kind."""
    lines = ["| change | photos | refused | landmarks, worst | avatar's head, worst | beyond 3 % |"]
    lines.append("|---|---|---|---|---|---|")
    for kind in [*KINDS, "all"]:
        here = [row for row in rows if kind in (row.kind, "all")]
        refused = sum(bool(row.refused) for row in here)
        worst = [_worst([getattr(row, name) for row in here]) for name in ("error", "avatar")]
        if here:
            wrong = sum(not row.right for row in here)
            lines.append(f"| {kind} | {len(here)} | {refused} | {' | '.join(worst)} | {wrong} |")
    return "\n".join(lines) + "\n"


def _worst(errors: list[float | None]) -> str:
    known = [error for error in errors if error is not None]
    return f"{max(known):.1%}" if known else "–"


def reasons(rows: list[Row]) -> str:
    """How often each sentence refused a photo, by kind."""
    counts = Counter((row.kind, row.refused.partition(";")[0]) for row in rows if row.refused)
    return "".join(f"{kind}: {count} x {what}\n" for (kind, what), count in sorted(counts.items()))


def main(argv: list[str] | None = None) -> int:
    """Print a line for each photo and the table; exit code 1 if one is silently wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--only", nargs="*", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--prepare-only", action="store_true", help="stop after the landmarks, a tenth of the time")
    parser.add_argument("--short", action="store_true", help="leave out what moves no landmark, half of the time")
    parser.add_argument("--rows", type=Path, help="file of what is done, to go on")
    parser.add_argument("--output", type=Path, help="folder for the table")
    arguments = parser.parse_args(argv)
    image, face = portrait()
    rows: list[Row] = []
    if arguments.rows is not None and arguments.rows.is_file():
        rows = [Row(**json.loads(line)) for line in arguments.rows.read_text().splitlines() if line.endswith("}")]
    done = {(row.kind, row.number) for row in rows}
    with tempfile.TemporaryDirectory() as folder:
        for index in range(arguments.count):
            kind, number = list(KINDS)[index % len(KINDS)], index // len(KINDS)
            if kind in arguments.only and (kind, number) not in done:
                how = (arguments.prepare_only, arguments.short)
                rows.append(try_one(kind, number, image, face, Path(folder), *how))
                line = json.dumps(_plain(rows[-1]))
                print(line, flush=True)
                if arguments.rows is not None:
                    with arguments.rows.open("a", encoding="utf-8") as file:
                        file.write(line + "\n")
    print(table(rows) + reasons(rows))
    if arguments.output is not None:
        arguments.output.mkdir(parents=True, exist_ok=True)
        (arguments.output / "stress_perturbed.md").write_text(table(rows), encoding="utf-8")
    return int(not all(row.right for row in rows))


def _plain(row: Row) -> dict[str, Any]:
    return {name: value for name, value in asdict(row).items() if value not in ("", None)}


if __name__ == "__main__":
    sys.exit(main())
