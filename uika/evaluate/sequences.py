"""Which frames of a sequence are sources and which are targets: a fixed choice, the same for every system."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import torch
from torch import Tensor

from uika.data import Capture, DataError, Sample
from uika.data.datasets import Person, open_person
from uika.evaluate.protocol import TURNED_AWAY
from uika.head import HeadModel, rodrigues
from uika.reconstruction import MAX_PHOTOS

Place = tuple[int, str]  # time step and camera
_MOST_STEPS = 2000  # of a sequence that are looked at; longer ones are thinned out evenly


@dataclass(frozen=True)
class Sequence:
    """A capture or shard with its chosen frames."""

    name: str
    identity: str
    person: Person
    sources: tuple[int, ...]  # indices into `person`, in the order in which more of them are used
    targets: tuple[int, ...]
    source_names: tuple[str, ...]  # time step and camera, STEP_CAMERA
    target_names: tuple[str, ...]


def sequence_name(path: Path) -> str:
    """The name of a capture's folder or a shard's file without its extension."""
    return path.stem if path.suffix == ".tar" else path.name


def choose_frames(path: Path, setting: str, targets: int, head: HeadModel) -> Sequence:
    """Open a sequence and choose its frames.

    Every other time step is held out for targets (with a single step: every other camera). Mono uses the most frontal
    camera, multi all that see the face at the first step; frames in which a head has turned away from its camera are no
    sources. Sources come in an order in which each is as far as possible from those before, so that the sources of
    fewer views are among those of more.

    Raises:
        DataError: the sequence cannot be used, or has too few frames.
    """
    person = open_person(path)
    place = _places(person)
    first = min(step for step, _ in place)
    opening = {camera: person.sample(index) for (step, camera), index in place.items() if step == first}
    for sample in opening.values():
        check_sample(sample, head)
    frontal = {camera: facing(sample) for camera, sample in opening.items()}
    cameras = sorted((camera for camera in frontal if frontal[camera] > TURNED_AWAY), key=lambda c: (-frontal[c], c))
    if not cameras:
        raise DataError(f"{path}: no camera sees the face at time step {first}")
    if setting == "mono":
        cameras = cameras[:1]
    directions = torch.stack([_direction(opening[camera]) for camera in cameras])
    cameras = [cameras[i] for i in farthest_first(directions)]
    steps = sorted({step for step, camera in place if camera in cameras})
    steps = steps[:: -(-len(steps) // _MOST_STEPS)]
    if len(steps) > 1:
        pools = (steps[::2], cameras), (steps[1::2], cameras)
    else:
        pools = (steps, cameras[::2]), (steps, cameras[1::2])
    order, held = ([at for at in _round_robin(*pool) if at in place] for pool in pools)
    shown = (at for at in order if facing(check_sample(person.sample(place[at]), head)) > TURNED_AWAY)
    sources = list(islice(shown, MAX_PHOTOS))
    if not sources or not held:
        raise DataError(f"{path}: has {len(steps)} time steps and {len(cameras)} cameras, too few to hold frames out")
    identity = next(iter(opening.values())).identity
    held = held[:targets]
    return Sequence(
        name=sequence_name(path),
        identity=identity,
        person=person,
        sources=tuple(place[at] for at in sources),
        targets=tuple(place[at] for at in held),
        source_names=tuple(f"{step:05d}_{camera}" for step, camera in sources),
        target_names=tuple(f"{step:05d}_{camera}" for step, camera in held),
    )


def check_sample(sample: Sample, head: HeadModel) -> Sample:
    """The sample, if it has parameters of this head model.

    Raises:
        DataError: it has none, or they are another model's.
    """
    if sample.parameters is None:
        raise DataError(f"{sample.key}: has no head parameters, which targets are driven by")
    vertices = len(head.without_bust.template)
    sizes = len(head.identity_basis), len(head.expression_basis), vertices
    offset = vertices if sample.static_offset is None else len(sample.static_offset)
    found = len(sample.parameters.identity), len(sample.parameters.expression), offset
    if found != sizes:
        raise DataError(f"{sample.key}: made for another head model (identities, expressions, vertices: {found})")
    return sample


def facing(sample: Sample) -> float:
    """Cosine between the direction of the face and that to the camera."""
    return float(_direction(sample)[2])


def farthest_first(points: Tensor) -> list[int]:
    """An order of points [N,D] that starts with the first and goes on with the one farthest from all before."""
    order = [0]
    distance = (points - points[0]).norm(dim=-1)
    while len(order) < len(points):
        distance[order] = -1
        order.append(int(distance.argmax()))
        distance = torch.minimum(distance, (points - points[order[-1]]).norm(dim=-1))
    return order


def _direction(sample: Sample) -> Tensor:
    """Unit vector [3] from the head to the camera, in the head's axes."""
    assert sample.parameters is not None  # check_sample
    turn = rodrigues(sample.parameters.rotation) @ rodrigues(sample.parameters.neck)
    away = sample.camera.position - sample.parameters.translation
    return turn.mT @ (away / away.norm())


def _places(person: Person) -> dict[Place, int]:
    """Time step and camera of every image; captures know them without reading images."""
    if isinstance(person, Capture):
        return {(frame.timestep, frame.camera_id): index for index, frame in enumerate(person.frames)}
    samples = ((index, person.sample(index)) for index in range(len(person)))
    return {(sample.timestep, sample.camera_id): index for index, sample in samples}


def _round_robin(steps: list[int], cameras: list[str]) -> list[Place]:
    """All pairs, such that neighbours in the list differ in both."""
    order = [steps[i] for i in farthest_first(torch.tensor(steps, dtype=torch.float64)[:, None])] if steps else []
    pairs = ((order[(turn + i) % len(order)], camera) for turn in range(len(order)) for i, camera in enumerate(cameras))
    return list(pairs)
