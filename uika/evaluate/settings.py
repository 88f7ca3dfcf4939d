"""What is evaluated, and the protocol that follows from it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from uika.errors import UikaError
from uika.evaluate.protocol import Protocol
from uika.head import HeadModel
from uika.io.weights import sha256
from uika.reconstruction import MAX_PHOTOS, LoadedModel

_SIZES = (32, 2048)
_DIGITS = 12  # of a file's digest


@dataclass(frozen=True)
class Evaluation:
    """What to evaluate; meanings as in `uika evaluate`."""

    data: Path
    output: Path
    setting: str = "mono"
    task: str = "self"
    views: tuple[int, ...] = (1, 2, 4, 8, 16)
    model: str = "tiny"
    estimator: Path | None = None
    backbone: Path | None = None
    name: str = ""
    correspondence: str = "fit"
    size: int = 512
    background: float = 1.0
    targets: int = 8
    lpips: Path | None = None
    arcface: Path | None = None
    external: Path | None = None


def protocol_of(settings: Evaluation, loaded: LoadedModel | None, head: HeadModel) -> Protocol:
    """The choices of a table; `loaded` is None for another system's pictures."""
    external = settings.external is not None
    name = settings.name or (settings.external.name if settings.external else Path(settings.model).stem)
    model = f"pictures in {name}" if loaded is None else f"model {loaded.name}"
    if loaded is not None and Path(settings.model).is_file():
        model = f"{model}, sha256 {sha256(Path(settings.model))[:_DIGITS]}"
    for kind, file in (("estimator", settings.estimator), ("backbone", settings.backbone)):
        if file is not None:
            model = f"{model}, {kind} {file.name}, sha256 {sha256(file)[:_DIGITS]}"
    return Protocol(
        data=settings.data.resolve().name,
        setting=settings.setting,
        task=settings.task,
        method=name,
        model=model,
        correspondence="" if external else settings.correspondence,
        head=head.id,
        size=settings.size,
        background=settings.background,
        targets=settings.targets,
        lpips="" if settings.lpips is None else sha256(settings.lpips)[:_DIGITS],
        arcface="" if settings.arcface is None else sha256(settings.arcface)[:_DIGITS],
    )


def check_settings(settings: Evaluation) -> None:
    """Refuse values that cannot be used; raises UikaError."""
    if not settings.views or not all(1 <= count <= MAX_PHOTOS for count in settings.views):
        raise UikaError(f"views must be numbers from 1 to {MAX_PHOTOS}, such as 1,2,4, not {list(settings.views)}")
    if not _SIZES[0] <= settings.size <= _SIZES[1]:
        raise UikaError(f"size must lie between {_SIZES[0]} and {_SIZES[1]} pixels, not {settings.size}")
    if not 0 <= settings.background <= 1:
        raise UikaError(f"background must be a grey level in [0,1], not {settings.background:g}")
    if settings.targets < 1:
        raise UikaError(f"targets must be at least 1, not {settings.targets}")
