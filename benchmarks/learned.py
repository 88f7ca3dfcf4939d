"""What training adds, on people it never saw: `python -m benchmarks.learned --data HELD_OUT --train TRAINED_ON`.

Three methods rebuild each person from N photos: the mean head of the people trained on, aggregation alone (the network
left out), and the trained network. Sources are the even time steps of the cameras in front, targets the odd ones of
other cameras, so that view and expression are both new. Results are kept line by line, and a second call goes on.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from benchmarks.harness import markdown, save
from tests.avatars import surface_avatar
from uika.avatar import Avatar
from uika.data import Capture
from uika.data.datasets import find_people, open_person
from uika.data.texture import true_texture
from uika.data.views import View
from uika.evaluate.protocol import TURNED_AWAY, Protocol
from uika.evaluate.reenactment import drive, observe_sources, target_views, truth_picture
from uika.evaluate.score import Judges, Pictures, mean, score
from uika.evaluate.sequences import facing
from uika.head import HeadModel, load_head, uv_texels
from uika.io.progress import counted
from uika.reconstruction import LoadedModel, Report, avatar_from_fit, load_model
from uika.uv import aggregate, diffuse

SOURCE_CAMERAS = ("00", "01", "02", "03", "04", "05")
METRICS = ("PSNR", "PSNR masked", "SSIM", "FLIP", "AKD")
METHODS = ("mean head", "aggregation only", "trained")
SIZE = 256
MEAN_OF = 100  # people, nine images each
OPACITY = 0.95


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames of one person: sources in the order in which more are used, targets, and all."""

    name: str
    sources: list[Any]
    targets: list[Any]
    everything: list[Any]


def frames_of(path: Path, most: int) -> Frames:
    """Read a capture; sources go through the cameras before they go through the time steps."""
    person = open_person(path)
    if not isinstance(person, Capture):
        raise SystemExit(f"{path}: this comparison reads capture folders")
    samples = [person.sample(index) for index in range(len(person))]
    front = [s for s in samples if s.camera_id in SOURCE_CAMERAS and s.timestep % 2 == 0 and facing(s) > TURNED_AWAY]
    cameras = {name: place for place, name in enumerate(SOURCE_CAMERAS)}
    # Neighbours in the list differ in time step and camera.
    steps = sorted({s.timestep for s in front})
    front.sort(key=lambda s: ((steps.index(s.timestep) - cameras[s.camera_id]) % len(steps), cameras[s.camera_id]))
    targets = [s for s in samples if s.camera_id not in SOURCE_CAMERAS and s.timestep % 2 == 1]
    return Frames(path.name, front[:most], targets, samples)


def mean_head(folder: Path, head: HeadModel, size: int) -> Avatar:
    """The average of the first people trained on: mean hair, mean colours, mean face."""
    texture, share = torch.zeros(3, size, size), torch.zeros(1, size, size)
    offset = torch.zeros_like(head.template)
    paths = find_people(folder)[:MEAN_OF]
    for path in counted(paths, True, len(paths), "mean head"):
        person = open_person(path)
        views = [View(person.sample(index), SIZE) for index in range(9)]
        seen = true_texture(views, size)
        texture, share = texture + seen[:3] * seen[3:], share + seen[3:]
        if views[0].static_offset is not None:
            offset += views[0].static_offset / len(paths)
    color = diffuse(texture / share.clamp_min(1), (share > 0).float()[None], torch.full((1, 3, size, size), 0.5))[0]
    return surface_avatar(head, size, lambda _, binding: binding.from_map(color), offset, OPACITY, model="mean head")


def unseen_texels(frames: Frames, count: int, avatars: dict[str, Avatar], head: HeadModel, size: int) -> dict[str, Any]:
    """PSNR of colours at texels that no source shows, against the mean colour in all images of the person."""
    views = [View(sample, SIZE) for sample in frames.sources[:count]]
    binding = uv_texels(head, size)
    truth = true_texture([View(sample, SIZE) for sample in frames.everything], size)
    uv = torch.stack([view.uv for view in views if view.uv is not None])[None]
    images, masks = (torch.stack([getattr(v, name) for v in views])[None] for name in ("image", "mask"))
    pooled = aggregate(images, uv, masks[:, :, None], size, close_radius=2, valid=binding.valid)
    unseen = binding.from_map((pooled.hits[0] <= 0) * truth[3:])[:, 0] > 0
    wanted = binding.from_map(truth[:3])[unseen]
    known = (pooled.hits > 0).float() * binding.valid
    filled = diffuse(pooled.rgb * known, known, torch.full_like(pooled.rgb, 0.5))[0]
    colors = {"diffused fill": binding.from_map(filled), **{name: avatar.colors for name, avatar in avatars.items()}}
    return {
        "share": float(unseen.float().mean()),
        **{name: float(-10 * (each[unseen] - wanted).square().mean().log10()) for name, each in colors.items()},
    }


@torch.no_grad()
def rows_of(
    frames: Frames, views: Sequence[int], how: str, models: dict[str, LoadedModel], average: Avatar, judges: Judges
) -> Iterator[dict[str, Any]]:
    """Scores of one person, a row for each method and number of photos."""
    head = judges.head
    protocol = Protocol("", "multi", "self", "", "", how, head.id, SIZE, 1.0, len(frames.targets))
    targets = target_views(frames.targets, protocol, head)
    truths = Pictures.of([truth_picture(view, 1.0) for view in targets])
    masks = [view.mask >= 0.5 for view in targets]

    def scored(avatar: Avatar) -> dict[str, float | None]:
        results = Pictures.of(drive(avatar, targets, head, 1.0), truths)
        scores = score(results, truths, masks, Pictures.of([]), protocol, judges)
        return {name: mean(scores[name]) for name in METRICS}

    nobody = scored(average)
    for count in views:
        if count > len(frames.sources):
            continue
        observed = observe_sources(frames.sources[:count], how, SIZE, head)
        avatars = {name: avatar_from_fit(model, head, *observed, Report()) for name, model in models.items()}
        unseen: dict[str, Any] = {}
        if how == "exact":
            unseen = unseen_texels(frames, count, avatars, head, models["trained"].network.config.map_size)
        every = {"mean head": nobody, **{name: scored(avatar) for name, avatar in avatars.items()}}
        for method, scores in every.items():
            yield {
                "person": frames.name,
                "correspondence": how,
                "views": count,
                "method": method,
                **scores,
                "unseen": unseen if method == "trained" else {},
            }


def tables(rows: Sequence[dict[str, Any]]) -> str:
    """The means over people as Markdown."""
    parts = []
    for how in ("exact", "fit"):
        chosen = [row for row in rows if row["correspondence"] == how]
        if not chosen:
            continue
        counts = sorted({row["views"] for row in chosen})
        lines: list[dict[str, object]] = []
        for method in METHODS:
            for count in counts:
                own = [row for row in chosen if (row["method"], row["views"]) == (method, count)]
                if own:
                    line: dict[str, object] = {"method": method, "photos": count, "people": len(own)}
                    lines.append(line | {name: _rounded(mean([row[name] for row in own])) for name in METRICS})
        parts.append(f"Correspondence: {how}\n\n{markdown(lines)}")
        unseen = [row for row in chosen if row["unseen"]]
        if unseen:
            names = list(unseen[0]["unseen"])
            parts.append("Texels that no photo shows, PSNR of their colours in dB:\n\n" + markdown([
                {"photos": count} | {n: _rounded(mean([r["unseen"][n] for r in unseen if r["views"] == count]))
                                     for n in names} for count in counts
            ]))  # fmt: skip
    return "\n\n".join(parts)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="held-out captures")
    parser.add_argument("--train", type=Path, required=True, help="captures that the model was trained on")
    parser.add_argument("--model", default="tiny")
    parser.add_argument("--people", type=int, default=50)
    parser.add_argument("--views", default="1,2,4,8,16")
    parser.add_argument("--correspondence", choices=("exact", "fit"), default="exact")
    parser.add_argument("--name", default="learned", help="of the result files")
    parser.add_argument("--rows", type=Path, default=Path("out/learned.jsonl"), help="finished rows")
    options = parser.parse_args()
    head = load_head().without_bust
    models = {"aggregation only": load_model("none"), "trained": load_model(options.model)}
    views = [int(part) for part in options.views.split(",")]
    options.rows.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in options.rows.read_text().splitlines()] if options.rows.exists() else []
    done = {(row["person"], row["correspondence"]) for row in rows}
    average = mean_head(options.train, head, models["trained"].network.config.map_size)
    paths = find_people(options.data)[: options.people]
    for path in counted(paths, True, len(paths), "people"):
        if (path.name, options.correspondence) in done:
            continue
        frames = frames_of(path, max(views))
        new = list(rows_of(frames, views, options.correspondence, models, average, Judges(head)))
        with options.rows.open("a") as file:
            file.writelines(json.dumps(row) + "\n" for row in new)
        rows += new
    save(options.name, "What training adds", tables(rows), {"rows": rows, "model": models["trained"].name})


if __name__ == "__main__":
    main()
