"""What skipping the background gains and costs: `python -m benchmarks.model_skipping [--people HELD_OUT]`.

The network reconstructs the bundled portrait, its avatar photographed from around, and people of `--people` (captures
that the model was not trained on) with everything and with the foreground alone, taking turns; then a ninth photo is
added to eight. Errors are those of the foreground against everything; `dB` compare pictures of the avatars with true
ones: of people, frames of other cameras and moments. The table has one row for each set, the JSON file one for each
person.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.figures import bars
from benchmarks.harness import interleaved, markdown, save
from benchmarks.learned import frames_of
from uika.assets import PORTRAIT
from uika.avatar import Avatar
from uika.avatar.rendering import render
from uika.data.datasets import find_people
from uika.data.views import View
from uika.evaluate.reenactment import drive, observe_sources, rounded, truth_picture
from uika.evaluate.rendered_views import make_views
from uika.fitting import Fit, pixel_uv
from uika.head import HeadModel, HeadParameters, load_head
from uika.io.video import write_png
from uika.metrics import psnr
from uika.model import CanonicalGaussians, Keep, Reconstructor, Session
from uika.reconstruction import GrowingAvatar, LoadedModel, Report, avatar_from_fit, fit_files, load_model, reconstruct
from uika.reconstruction.model_inputs import ModelInputs, model_inputs

SIZE = 256  # pixels of people's photos and of the pictures that are compared
TARGETS = 8
AROUND = 17  # views of the portrait's avatar; the last is never a source
WAYS: tuple[Keep, ...] = ("all", "foreground")


@dataclass(frozen=True, eq=False)
class Case:
    """Views of one head, and true pictures of it."""

    name: str
    inputs: ModelInputs
    avatar: Avatar  # whose Gaussians are replaced
    targets: list[Any]  # of `drive`, or (parameters, camera)
    truths: list[Tensor]  # [S,S,3]
    mask: Tensor | None = None  # [S,S] pixels that count

    def first(self, count: int, last: int | None = None) -> tuple[Tensor, ...]:
        """The photos from `count` - or before `count` if `last` is None - to before `last`."""
        part = slice(count) if last is None else slice(count, last)
        return tuple(value[:, part] for value in self.inputs[:4])


def portrait(loaded: LoadedModel, head: HeadModel) -> Case:
    """The demo photo, compared with itself."""
    photo = fit_files([PORTRAIT], head)
    inputs = _inputs(loaded, head, photo.fit, photo.images, photo.mattes)
    avatar = avatar_from_fit(loaded, head, *photo[1:], Report())
    target = photo.fit.parameters[0], photo.fit.cameras[0]
    head_alone = render(avatar, *target, head).alpha > 0.5  # the photo shows shoulders, too
    return Case("demo photo", inputs, avatar, [target], [photo.images[0].permute(1, 2, 0)], mask=head_alone)


def around(loaded: LoadedModel, head: HeadModel) -> Case:
    """The portrait's avatar at 512 x 512 pixels from around."""
    views = make_views(AROUND)
    params = HeadParameters.zeros(head).replace(identity=views.avatar.identity)
    fit = Fit(HeadParameters.stack([params] * AROUND), views.cameras, views.avatar.static_offset, torch.zeros(AROUND))
    inputs = _inputs(loaded, head, fit, views.images[0], views.masks[0, :, 0])
    targets, truth = [(params, views.cameras[AROUND - 1])], views.images[0, -1].permute(1, 2, 0)
    return Case("portrait from around", inputs, views.avatar, targets, [truth])


def people(loaded: LoadedModel, head: HeadModel, folder: Path, most: int, count: int) -> Iterator[Case]:
    """Captured people with as many sources as are wanted."""
    for path in find_people(folder)[:count]:
        frames = frames_of(path, most)
        observed = observe_sources(frames.sources, "exact", SIZE, head)
        inputs = _inputs(loaded, head, observed.fit, observed.images, observed.mattes)
        avatar = avatar_from_fit(load_model("none"), head, *observed, Report())
        targets = [View(sample, SIZE) for sample in frames.targets[:TARGETS]]
        yield Case("held-out people", inputs, avatar, targets, [truth_picture(view, 1.0) for view in targets])


def measure(case: Case, model: Reconstructor, views: int, repeats: int, head: HeadModel) -> dict[str, Any]:
    """Everything against the foreground for the first photos of a case."""
    photos, rest = case.first(views), case.inputs[4:]
    work = {way: partial(model, *photos, *rest, way) for way in WAYS}
    times = interleaved(work, dict.fromkeys(WAYS, repeats), warm=1)
    dense, kept = (model(*photos, *rest, way) for way in WAYS)
    quality = [_quality(case, result, head) for result in (dense, kept)]
    return {
        "set": case.name,
        "views": views,
        "all ms": times["all"].best,
        "foreground ms": times["foreground"].best,
        "speed-up": times["all"].best / times["foreground"].best,
        "CPU speed-up": times["all"].cpu / times["foreground"].cpu,
        "skipped patches": kept.report["skipped_patches"] / kept.report["patches"],
        "means mm": 1e3 * (kept.means - dense.means).norm(dim=-1).mean().item(),
        "colour": (kept.colors - dense.colors).abs().mean().item(),
        "all dB": quality[0],
        "foreground dB": quality[1],
        "change dB": quality[1] - quality[0],
    }


def increment(case: Case, model: Reconstructor, views: int, repeats: int) -> dict[str, Any]:
    """The cost of the last photo against that of all from nothing."""
    parts = {way: _increment(case, model, views, repeats, way) for way in WAYS}
    return {"set": case.name, "photos": views} | {
        f"{way} {field}": value for way, fields in parts.items() for field, value in fields.items()
    }


def _increment(case: Case, model: Reconstructor, views: int, repeats: int, way: Keep) -> dict[str, float]:
    texel, surface = case.inputs[4:]
    together = case.first(views)

    def started() -> Session:
        session = Session(model, texel, surface, way)
        session.add(*case.first(views - 1))
        return session

    def add() -> CanonicalGaussians:
        return waiting.pop().add(*case.first(views - 1, views))

    def everything() -> CanonicalGaussians:
        return model(*together, texel, surface, way)

    waiting = [started() for _ in range(repeats + 2)]
    times = interleaved({"new": add, "whole": everything}, {"new": repeats, "whole": repeats}, warm=1)
    new, whole = add(), everything()
    return {
        "new ms": times["new"].best,
        "whole ms": times["whole"].best,
        "share": times["new"].best / times["whole"].best,
        "means mm": 1e3 * (new.means - whole.means).norm(dim=-1).mean().item(),
        "colour": (new.colors - whole.colors).abs().mean().item(),
    }


def from_files(case: Case, head: HeadModel, count: int) -> dict[str, Any]:
    """Seconds for the last of `count` photo files and for all of them, preparation and fit included."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{index}.png" for index in range(count)]
        for path, image in zip(paths, case.inputs.images[0], strict=False):
            write_png(path, image.permute(1, 2, 0))
        growing = GrowingAvatar(head=head)
        growing.add(paths[:-1])
        clock = [time.perf_counter()]
        for task in (partial(growing.add, paths[-1:]), partial(reconstruct, paths, head)):
            task()
            clock.append(time.perf_counter())
    new, whole = clock[1] - clock[0], clock[2] - clock[1]
    return {"photos": count, "new s": round(new, 2), "whole s": round(whole, 2), "share": round(new / whole, 3)}


def _inputs(loaded: LoadedModel, head: HeadModel, fit: Fit, images: Tensor, mattes: Tensor) -> ModelInputs:
    uv, valid, weight = pixel_uv(fit, head, mattes)
    uv = torch.where(valid[..., None], uv, torch.nan).permute(0, 3, 1, 2)
    config, identity = loaded.network.config, fit.parameters.identity[0]
    return model_inputs(config, head, identity, fit.static_offset, images, mattes, uv, weight)[0]


def _quality(case: Case, result: CanonicalGaussians, head: HeadModel) -> float:
    """Mean PSNR of the avatar's pictures."""
    names = ("means", "quats", "scales", "opacities", "colors")
    parts = {name: result[name][0].float().contiguous() for name in names}
    avatar = replace(case.avatar, **parts | {"colors": parts["colors"].clamp(0, 1)})
    if isinstance(case.targets[0], View):
        pictures = drive(avatar, case.targets, head, 1.0)
    else:
        pictures = [rounded(render(avatar, params, camera, head).rgb) for params, camera in case.targets]
    return statistics.fmean(psnr(*pair, case.mask) for pair in zip(pictures, case.truths, strict=True))


def summary(rows: Sequence[dict[str, Any]], key: str) -> list[dict[str, Any]]:
    """Means over the heads of a set with equally many photos."""
    groups = dict.fromkeys((row["set"], row[key]) for row in rows)
    table = []
    for name, count in groups:
        own = [row for row in rows if (row["set"], row[key]) == (name, count)]
        values = {field: statistics.fmean(row[field] for row in own) for field in own[0] if field not in ("set", key)}
        table.append({"set": name, key: count, "heads": len(own)} | {f: float(f"{v:.3g}") for f, v in values.items()})
    return table


@torch.no_grad()
def main(argv: Sequence[str] | None = None) -> int:
    """Measure and write the table and the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=Path, help="folder of captures that the model has not seen")
    parser.add_argument("--count", type=int, default=4, help="people of it")
    parser.add_argument("--model", default="tiny", help="built-in network or a trained model file")
    parser.add_argument("--views", type=int, nargs="+", default=[4, 16])
    parser.add_argument("--photos", type=int, default=9, help="photos after the last one is added")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--name", default="model_skipping", help="of the result files")
    options = parser.parse_args(argv)
    head, loaded = load_head().without_bust, load_model(options.model)
    cases = [around(loaded, head)]
    if options.people:
        cases += people(loaded, head, options.people, max(*options.views, options.photos), options.count)
    rows = [measure(portrait(loaded, head), loaded.network, 1, options.repeats, head)]
    grown = []
    for case in cases:
        held = case.inputs.images.shape[1]
        for views in (count for count in options.views if count <= held):
            rows.append(measure(case, loaded.network, views, options.repeats, head))
            print({name: value for name, value in rows[-1].items() if "ms" not in name}, flush=True)
        if options.photos <= held:
            grown.append(increment(case, loaded.network, options.photos, options.repeats))
    text = f"Model: {loaded.name}. Milliseconds are the least of {options.repeats} runs that took turns.\n\n"
    text += markdown(summary(rows, "views"))
    if grown:
        text += f"\n\nThe last of {options.photos} photos, added to a session:\n\n{markdown(summary(grown, 'photos'))}"
    files = from_files(cases[0], head, options.photos)
    text += f"\n\nThe same from the portrait's files, preparation and fit included:\n\n{markdown([files])}"
    save(
        options.name, "Network: skipping what shows nothing", text, {"rows": rows, "increments": grown, "files": files}
    )
    shown = {f"{row['set']}, {row['views']}": row for row in summary(rows, "views")}
    panels = {"time": {way: {label: row[f"{way} ms"] for label, row in shown.items()} for way in WAYS}}
    bars(options.name, panels, "milliseconds")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
