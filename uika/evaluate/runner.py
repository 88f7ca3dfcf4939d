"""From data and a model to the results of every sequence."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from uika.avatar import Avatar
from uika.data import DataError
from uika.data.datasets import find_people, left_out
from uika.data.views import View
from uika.errors import UikaError
from uika.evaluate.external import check_external, external_picture
from uika.evaluate.protocol import Protocol
from uika.evaluate.reenactment import Cutouts, drive, make_avatar, target_views, truth_picture
from uika.evaluate.score import Judges, Pictures, faces_found, score
from uika.evaluate.sequences import Sequence, choose_frames
from uika.evaluate.settings import Evaluation, check_settings, protocol_of
from uika.evaluate.store import (
    PICTURES,
    Result,
    agree,
    plain_name,
    read_result,
    result_file,
    write_frames,
    write_result,
)
from uika.evaluate.strips import write_strip
from uika.head import HeadModel, load_head
from uika.io.files import check_folder
from uika.io.progress import counted
from uika.metrics.arcface import ArcFace
from uika.metrics.lpips import Lpips
from uika.photo import PhotoError
from uika.reconstruction import LoadedModel, check_loaded, load_model

TRUTHS = 4  # sequences whose targets are remembered
SHOWN = 2  # targets of each result that pictures are kept of


@dataclass(frozen=True)
class Outcome:
    """What a run did: results made and kept, and one sentence for each that could not be made."""

    protocol: Protocol
    made: int
    kept: int
    missing: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Truth:
    """The targets of a sequence."""

    views: list[View]
    pictures: Pictures
    masks: list[Tensor]


@dataclass
class _Plan:
    """What one table needs, and what of it is done."""

    settings: Evaluation
    protocol: Protocol
    folder: Path
    drivers: dict[str, Sequence]  # by the name of the sequence that they drive
    jobs: list[tuple[Sequence, int]]  # with the number of views
    missing: list[str]
    made: int = 0
    kept: int = 0


def evaluate(settings: Evaluation, head: HeadModel | None = None, progress: bool = False) -> Outcome:
    """Score all sequences that have no result yet; `uika.evaluate.write_report` makes the tables.

    Raises:
        UikaError: the settings, the data or a weights file cannot be used, the report's folder holds results of other
            choices, or frames of the other system are missing.
    """
    return evaluate_all([settings], head, progress)[0]


@torch.no_grad()
def evaluate_all(
    many: Iterable[Evaluation], head: HeadModel | None = None, progress: bool = False
) -> tuple[Outcome, ...]:
    """Fill several tables of one model that differ in setting and task: each avatar is made once for all of them.

    Raises:
        UikaError: as `evaluate` does.
    """
    wanted = list(many)
    first = wanted[0]
    for settings in wanted:
        check_settings(settings)
    head = (load_head() if head is None else head).without_bust
    loaded = None if first.external else load_model(first.model, first.estimator, first.backbone)
    if loaded is not None:
        check_loaded(loaded, head, first.estimator)
    judges = Judges(
        head,
        None if first.lpips is None else Lpips(first.lpips),
        None if first.arcface is None else ArcFace(first.arcface),
    )
    plans = [_plan(settings, loaded, head) for settings in wanted]
    run = _Run(loaded, judges)
    # All that shares frames comes together.
    jobs = sorted(
        ((sequence, views, plan) for plan in plans for sequence, views in plan.jobs),
        key=lambda job: (job[0].name, job[2].settings.setting, job[1]),
    )
    for sequence, views, plan in counted(jobs, progress, len(jobs), "evaluate"):
        if read_result(result_file(plan.folder, sequence.name, views), plan.protocol) is not None:
            plan.kept += 1
            continue
        try:
            write_result(plan.folder, run.result(plan, sequence, views))
            plan.made += 1
        except (DataError, PhotoError) as error:
            plan.missing.append(f"{sequence.name} with {views} views: {error}")
    return tuple(Outcome(plan.protocol, plan.made, plan.kept, tuple(plan.missing)) for plan in plans)


def _plan(settings: Evaluation, loaded: LoadedModel | None, head: HeadModel) -> _Plan:
    """Choose frames, and make sure that the report's folder and another system's pictures fit them."""
    protocol = protocol_of(settings, loaded, head)
    missing: list[str] = []
    sequences = []
    for path in find_people(settings.data):
        try:
            sequences.append(choose_frames(path, settings.setting, settings.targets, head))
        except DataError as error:
            missing.append(str(error))
    if not sequences:
        raise UikaError(f"{settings.data}: no sequence can be used; the first reason: {missing[0]}")
    missing += [note for each in sequences for note in left_out(each.person)]
    drivers = {each.name: _driver(sequences, index, settings) for index, each in enumerate(sequences)}
    jobs = []
    for sequence in sequences:
        for views in sorted(set(settings.views)):
            if views <= len(sequence.sources):
                jobs.append((sequence, views))
            else:
                missing.append(f"{sequence.name}: has {len(sequence.sources)} source frames, too few for {views} views")
    if not jobs:
        raise UikaError(f"{settings.data}: no sequence has enough source frames; the first reason: {missing[-1]}")
    if settings.external is not None:
        check_external(settings.external, [(s.name, v, drivers[s.name].target_names) for s, v in jobs])
    folder = agree(check_folder(settings.output), protocol)
    write_frames(folder, {s.name: _frames(s, drivers[s.name]) for s in sequences})
    return _Plan(settings, protocol, folder, drivers, jobs, missing)


class _Run:
    """One evaluation; faces, photos and avatars that several results need are made once."""

    def __init__(self, loaded: LoadedModel | None, judges: Judges) -> None:
        self._loaded, self._judges = loaded, judges
        self._cutouts = Cutouts()
        self._truths: OrderedDict[tuple[object, ...], _Truth] = OrderedDict()
        self._avatar: tuple[object, Avatar, float] | None = None

    def result(self, plan: _Plan, sequence: Sequence, views: int) -> Result:
        """Make an avatar of a sequence and score it."""
        protocol, judges, driver = plan.protocol, self._judges, plan.drivers[sequence.name]
        truth, seconds = self._truth(driver, protocol), 0.0
        if self._loaded is None:
            assert plan.settings.external is not None
            place = plan.settings.external, sequence.name, views
            images = [external_picture(*place, name, protocol.size) for name in driver.target_names]
        else:
            avatar, seconds = self._made(sequence, views, plan.settings.correspondence)
            images = drive(avatar, truth.views, judges.head, protocol.background)
        crossed = protocol.task == "cross"
        # Between two people a result's face counts without one in the truth.
        results = Pictures.of(images, None if crossed else truth.pictures)
        (first,) = target_views([sequence.person.sample(sequence.sources[0])], protocol, judges.head)
        shown = truth_picture(first, protocol.background)
        person = Pictures.of([shown] if crossed else [])
        return Result(
            protocol=protocol.digest(),
            sequence=sequence.name,
            views=views,
            driver=driver.name,
            sources=sequence.source_names[:views],
            targets=driver.target_names,
            scores=score(results, truth.pictures, truth.masks, person, protocol, judges),
            faces=len(faces_found(results, truth.pictures)),
            seconds=round(seconds, 2),
            pictures=tuple(_strips(plan, sequence, views, shown, results, truth)),
        )

    def _made(self, sequence: Sequence, views: int, correspondence: str) -> tuple[Avatar, float]:
        """The avatar of a sequence and the seconds that it took; the last one is remembered."""
        assert self._loaded is not None
        name = sequence.name, sequence.source_names[:views], correspondence
        if self._avatar is None or self._avatar[0] != name:
            samples = [sequence.person.sample(index) for index in sequence.sources[:views]]
            start = time.perf_counter()
            avatar = make_avatar(samples, self._loaded, correspondence, self._judges.head, self._cutouts)
            self._avatar = name, avatar, time.perf_counter() - start
        return self._avatar[1], self._avatar[2]

    def _truth(self, driver: Sequence, protocol: Protocol) -> _Truth:
        name = driver.name, driver.target_names, protocol.size, protocol.background
        if name not in self._truths:
            samples = [driver.person.sample(index) for index in driver.targets]
            views = target_views(samples, protocol, self._judges.head)
            pictures = Pictures.of([truth_picture(view, protocol.background) for view in views])
            self._truths[name] = _Truth(views, pictures, [view.mask >= 0.5 for view in views])
        self._truths.move_to_end(name)
        while len(self._truths) > TRUTHS:
            self._truths.popitem(last=False)
        return self._truths[name]


def _strips(
    plan: _Plan, sequence: Sequence, views: int, source: Tensor, results: Pictures, truth: _Truth
) -> Iterator[str]:
    """Write pictures of the first targets; paths inside the report's folder."""
    protocol, report = plan.protocol, plan.settings.output
    place = Path(PICTURES) / f"{protocol.setting}-{protocol.task}" / plain_name(protocol.method)
    for index in range(min(SHOWN, len(results.images))):
        name = place / f"{plain_name(sequence.name)}_{views:02d}_{index}.png"
        write_strip(report / name, source, results.images[index], truth.pictures.images[index], protocol.task)
        yield name.as_posix()


def _driver(sequences: list[Sequence], index: int, settings: Evaluation) -> Sequence:
    """Whose frames drive a sequence: its own, or for cross reenactment those of the next other person."""
    own = sequences[index]
    if settings.task == "self":
        return own
    for step in range(1, len(sequences)):
        other = sequences[(index + step) % len(sequences)]
        if other.identity != own.identity:
            return other
    raise UikaError(f"{settings.data}: cross reenactment needs two people, and only '{own.identity}' can be used")


def _frames(sequence: Sequence, driver: Sequence) -> dict[str, object]:
    return {"sources": sequence.source_names, "driver": driver.name, "targets": driver.target_names}
