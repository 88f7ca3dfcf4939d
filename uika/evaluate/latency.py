"""Time, memory and error of the network at several numbers of views, on renders of the bundled portrait's avatar."""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import nn

from uika.avatar.rendering import render
from uika.evaluate.rendered_views import Views, make_views
from uika.head import HeadParameters
from uika.io.files import write_tensors
from uika.metrics import psnr
from uika.model import ESTIMATORS, CanonicalGaussians, Estimator, Reconstructor, Session, build, load_checkpoint

CONFIGURATIONS = ("fp32 dense", "fp32 foreground", "bf16 dense", "bf16 foreground", "cached increment")


@dataclass
class Figures:
    """One configuration at one number of views, against dense float32."""

    views: int
    configuration: str
    wall_s: float = math.nan
    cpu_s: float = math.nan
    peak_gib: float = math.nan
    stages: dict[str, float] = field(default_factory=dict)
    means_mm: float = math.nan
    colors: float = math.nan
    render_psnr: float = math.nan
    photo_psnr: float = math.nan
    skipped_patches: float = math.nan


class Kept:
    """Finished rows and the Gaussians that later ones are compared with, in a folder or, without one, in memory."""

    def __init__(self, folder: Path | None) -> None:
        """Read what a folder has; it is made when needed."""
        self._folder = folder
        self._references: dict[int, list[torch.Tensor]] = {}
        self.rows: list[Figures] = []
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            if self._file.exists():
                self.rows = [Figures(**json.loads(line)) for line in self._file.read_text().splitlines()]

    @property
    def _file(self) -> Path:
        return (self._folder or Path()) / "rows.jsonl"

    def has(self, count: int, name: str) -> bool:
        """Whether a row is finished."""
        return any((row.views, row.configuration) == (count, name) for row in self.rows)

    def add(self, row: Figures) -> None:
        """Keep a row."""
        self.rows.append(row)
        if self._folder is not None:
            with self._file.open("a") as file:
                file.write(json.dumps(asdict(row)) + "\n")

    def reference(self, count: int, result: CanonicalGaussians) -> list[torch.Tensor]:
        """The five tensors that results with `count` views are compared with: the first that was given."""
        path = None if self._folder is None else self._folder / f"{count}.safetensors"
        if count not in self._references and path is not None and path.exists():
            tensors = load_file(path)
            self._references[count] = [tensors[str(index)] for index in range(len(tensors))]
        if count not in self._references:
            self._references[count] = [part.float().contiguous() for part in result]
            if path is not None:
                write_tensors(path, {str(i): part for i, part in enumerate(self._references[count])}, {})
        return self._references[count]


def run(
    model: Reconstructor,
    estimator: Estimator | None,
    views: Views,
    counts: Sequence[int],
    wanted: Sequence[str],
    kept: Kept,
) -> Iterator[Figures]:
    """Measure every wanted configuration at every number of views; dense float32 comes first and is the reference."""
    halved = {"bf16 dense", "bf16 foreground"}
    for half in (False, True):
        names = [name for name in CONFIGURATIONS if name in wanted and (name in halved) == half]
        if half and names:
            model.halve()
        for count in counts:
            for name in names:
                if kept.has(count, name):
                    continue
                figures, result = _measure(model, estimator, views, count, name)
                _compare(figures, list(result), kept.reference(count, result), views)
                kept.add(figures)
                yield figures


def _measure(
    model: Reconstructor, estimator: Estimator | None, views: Views, count: int, name: str
) -> tuple[Figures, CanonicalGaussians]:
    keep = "foreground" if "foreground" in name or "cached" in name else "all"
    images, masks, uv, weight, texel, surface = views.inputs(count)
    rows = (images, masks, uv, weight)

    def whole() -> CanonicalGaussians:
        if estimator is not None:
            estimator(images)
        return model(*rows, texel, surface, keep)

    def increment() -> CanonicalGaussians:
        if estimator is not None:
            estimator(images[:, -1:])
        return session.add(*(row[:, -1:] for row in rows))

    task = whole
    if name == "cached increment":
        session = Session(model, texel, surface)
        if count > 1:
            session.add(*(row[:, :-1] for row in rows))
        task = increment
    figures = Figures(count, name)
    with torch.no_grad(), _timed(model, estimator, figures):
        result = task()
    report = result.report
    figures.skipped_patches = report["skipped_patches"] / report["patches"]
    return figures, result


@contextmanager
def _timed(model: Reconstructor, estimator: Estimator | None, figures: Figures) -> Iterator[None]:
    """Fill in wall and processor seconds, those of the stages, and peak memory."""
    started: dict[str, float] = {}
    handles = []

    def watch(first: nn.Module, last: nn.Module, stage: str) -> None:
        def before(*_: object) -> None:
            started[stage] = time.process_time()

        def after(*_: object) -> None:
            now = time.process_time()
            figures.stages[stage] = figures.stages.get(stage, 0.0) + now - started[stage]
            started[stage] = now

        handles.extend([first.register_forward_pre_hook(before), last.register_forward_hook(after)])

    if estimator is not None:
        watch(estimator, estimator, "estimator")
    # The backbone runs by several methods, all from its patches to its norm.
    watch(model.encoder.model.patch_embed, model.encoder.model.norm, "backbone")
    watch(model.transformer, model.transformer, "transformer")
    watch(model.gs_decoder, model.gs_decoder, "decoder")
    _reset_peak()
    wall, cpu = time.perf_counter(), time.process_time()
    yield
    figures.wall_s, figures.cpu_s = time.perf_counter() - wall, time.process_time() - cpu
    figures.peak_gib = _peak_gib()
    figures.stages["reprojection, filling, rest"] = figures.cpu_s - sum(figures.stages.values())
    for handle in handles:
        handle.remove()


def _compare(figures: Figures, result: Sequence[torch.Tensor], reference: Sequence[torch.Tensor], views: Views) -> None:
    figures.means_mm = 1e3 * (result[0] - reference[0]).norm(dim=-1).mean().item()
    figures.colors = (result[4] - reference[4]).abs().mean().item()
    picture, expected = (_picture(each, views) for each in (result, reference))
    figures.render_psnr = psnr(picture, expected)
    figures.photo_psnr = psnr(picture, views.images[0, 0].permute(1, 2, 0))


def _picture(result: Sequence[torch.Tensor], views: Views) -> torch.Tensor:
    means, quats, scales, opacities, colors = (part[0].float().contiguous() for part in result)
    avatar = replace(
        views.avatar, means=means, quats=quats, scales=scales, opacities=opacities, colors=colors.clamp(0, 1)
    )
    params = HeadParameters.zeros(views.head).replace(identity=avatar.identity)
    return render(avatar, params, views.cameras[0], views.head).rgb


def _reset_peak() -> None:
    # Linux forgets the high-water mark on this word; elsewhere the mark of the whole run has to do.
    reset = Path("/proc/self/clear_refs")
    if reset.exists():
        reset.write_text("5")


def _peak_gib() -> float:
    status = Path("/proc/self/status")
    found = re.search(r"VmHWM:\s+(\d+) kB", status.read_text()) if status.exists() else None
    if found:
        return int(found[1]) / 2**20
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def perturb_weights(model: Reconstructor, seed: int = 0) -> None:
    """Add noise to every matrix, so that layers which start at zero take part as after a training."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.ndim > 1:
                spread = 0.3 / math.sqrt(parameter[0].numel())
                parameter.add_(spread * torch.randn(parameter.shape, generator=generator))


def table(rows: Sequence[Figures]) -> str:
    """Markdown; processor seconds per stage."""
    stages = list(dict.fromkeys(stage for row in rows for stage in row.stages))
    head = ["views", "configuration", "wall s", "CPU s", "peak GiB", *stages, "skipped", "means mm", "colour", "dB"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in rows:
        cells = [str(row.views), row.configuration, f"{row.wall_s:.2f}", f"{row.cpu_s:.2f}", f"{row.peak_gib:.2f}"]
        cells += [f"{row.stages.get(stage, 0.0):.2f}" for stage in stages]
        cells += [f"{row.skipped_patches:.0%}", f"{row.means_mm:.4f}", f"{row.colors:.1e}", f"{row.render_psnr:.1f}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def measure_network(
    preset: str,
    views: Sequence[int],
    configurations: Sequence[str] = CONFIGURATIONS,
    model: str | Path | None = None,
    estimator: bool = False,
    kept: Path | None = None,
) -> Iterator[Figures]:
    """Every wanted configuration at every number of views, finished ones of the folder `kept` included.

    Args:
        preset: "tiny", "base" or "paper"; the weights are random.
        views: numbers of photos.
        configurations: some of `CONFIGURATIONS`; dense float32 is measured in any case.
        model: a trained model file instead of the preset.
        estimator: run the correspondence estimator too.
        kept: folder for finished rows, of this preset and machine alone.

    Raises:
        ValueError: the model file cannot be used.
    """
    pictures = make_views(max(views))
    network, dense = _networks(preset, model, estimator)
    if preset != "paper":  # the first run of a process is slower; of the paper's size it would take minutes
        with torch.no_grad():
            network(*pictures.inputs(1))
    rows = Kept(kept)
    yield from rows.rows
    yield from run(network, dense, pictures, views, [CONFIGURATIONS[0], *configurations], rows)


def _networks(preset: str, model: str | Path | None, estimator: bool) -> tuple[Reconstructor, Estimator | None]:
    if model is not None:
        return load_checkpoint(model), None
    network = build(preset).eval()
    perturb_weights(network)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return network, Estimator(ESTIMATORS[preset]).eval() if estimator else None


def in_order(rows: Iterable[Figures]) -> list[Figures]:
    """Rows by number of views, then by configuration."""
    return sorted(rows, key=lambda row: (row.views, CONFIGURATIONS.index(row.configuration)))
