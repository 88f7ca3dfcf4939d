"""Items out of people: photos as the model will meet them in use, and pictures to compare its result with."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from uika.data import DataError
from uika.data.datasets import People, Person, left_out
from uika.data.labels import check_parameters, tracked_uv
from uika.data.texture import true_texture
from uika.data.views import View
from uika.head import Camera, HeadModel, HeadParameters, load_head, pose_vertices, rodrigues, shaped_vertices
from uika.reconstruction.model_inputs import model_inputs
from uika.train.augment import Grade, degrade, draw_grade
from uika.train.config import TrainConfig
from uika.train.item import Item
from uika.train.photographed import Photographed, photograph, photographed_sources
from uika.train.sampler import Draw
from uika.train.sources import GRADE_BETWEEN, Sources, drawn_sources
from uika.train.truth import driving, poses_in, true_coverage, true_surface

_TRIES = 3  # people tried in the place of one that cannot be read
_BACKGROUNDS = (0.0, 0.5, 1.0)  # grey levels behind pictures to compare with
_GREY = 0.06  # odds of somebody whose photos are grey


class ItemMaker(torch.utils.data.Dataset[Item]):
    """Draws -> items; the same draw always makes the same item, in whichever process."""

    def __init__(self, people: People, config: TrainConfig) -> None:
        """`people` must survive pickling."""
        self._people, self._config = people, config
        self._photos: dict[tuple[int, str], Photographed | None] = {}  # of the last person

    def __len__(self) -> int:
        """The number of people."""
        return len(self._people)

    def __getitem__(self, draw: Draw) -> Item:
        """Make one item.

        Raises:
            DataError: several people in a row cannot be used.
        """
        notes: list[str] = []
        for attempt in range(_TRIES):
            person = (draw.person + attempt) % len(self._people)
            try:
                return self._make(self._people[person], person, draw, notes)
            except DataError as error:
                notes.append(f"replaced: {error}")
        first = notes[0].removeprefix("replaced: ")
        raise DataError(f"{_TRIES} people in a row cannot be used; the first: {first}")

    def _make(self, person: Person, number: int, draw: Draw, replaced: list[str]) -> Item:
        notes = (*replaced, *left_out(person))
        random = np.random.default_rng(draw.seed)
        config, head = self._config, load_head().without_bust
        wanted = config.targets + (config.atlas_views if config.losses.atlas else 0)
        if config.part == "estimator":
            photos, _ = _choose(person, draw.sources, 0, config, random, head)
            return _labelled(photos, notes, config, head, random)
        fitted = config.model.canonical != "template" and random.random() < config.fitted
        used = fitted and config.photographed
        # Photos that are prepared as in use are shared by all items of a person, and so is their grade.
        grader = np.random.default_rng([config.seed, number]) if used else random
        shared = draw_grade(grader, grey=_GREY) if config.augment else Grade()

        def found(view: View) -> bool:
            return not used or self._photo(number, view, shared) is not None

        photos, pictures = _choose(person, draw.sources, wanted, config, random, head, found)
        for view in (*photos, *pictures):
            check_parameters(view, head)
            view.image = shared(view.image)
        keys = tuple(view.key for view in (*photos, *pictures))
        texture = true_texture((*photos, *pictures), config.model.map_size) if config.losses.atlas else torch.zeros(0)
        if used:
            taken = [self._photo(number, view, shared) for view in photos]
            sources = photographed_sources([each for each in taken if each is not None], head)
        else:
            level = config.backgrounds[random.integers(len(config.backgrounds))]
            sources = drawn_sources(photos, head, random, level, augment=config.augment, exact=not fitted)
        return _item(sources, pictures[: config.targets], texture, keys, notes, config, head, random)

    def _photo(self, number: int, view: View, shared: Grade) -> Photographed | None:
        """A view as a prepared photo, kept until another person's turn."""
        key = number, view.key
        if key not in self._photos:
            self._photos = {known: photo for known, photo in self._photos.items() if known[0] == number}
            random = np.random.default_rng([self._config.seed, number, *view.key.encode()])
            own = draw_grade(random, GRADE_BETWEEN) if self._config.augment else Grade()
            self._photos[key] = photograph(view, shared, own, random if self._config.augment else None)
        return self._photos[key]


def _item(
    sources: Sources,
    targets: list[View],
    texture: Tensor,
    keys: tuple[str, ...],
    notes: tuple[str, ...],
    config: TrainConfig,
    head: HeadModel,
    random: np.random.Generator,
) -> Item:
    """What a network is fed and judged by: pictures of the targets, then the photos' own views."""
    fit, identity = sources.fit, sources.fit.parameters.identity[0]
    inputs, _ = model_inputs(
        config.model, head, identity, fit.static_offset, sources.images, sources.masks, sources.uv, sources.weight
    )
    surface = inputs.surface
    own = sources.views[: config.own]
    views = [*targets, *own]
    posed, cameras = poses_in(targets, head, None if sources.exact else fit)
    if own:
        as_fitted = pose_vertices(head, fit.parameters, fit.static_offset)[: len(own)]
        posed = torch.cat((posed, as_fitted))
        cameras = Camera.stack([*(cameras[n] for n in range(len(targets))), *(fit.cameras[n] for n in range(len(own)))])
    person = torch.stack([view.mask for view in views])[:, None]
    coverage = person
    if config.outline == "splats":
        coverage = true_coverage(views, head, config.model.map_size, config.model.gaussians.init_opacity)
    backgrounds = torch.from_numpy(random.choice(_BACKGROUNDS, len(views))).float()[:, None].expand(-1, 3)
    shown = zip(views, backgrounds, coverage[:, 0], strict=True)
    pictures = [view.over(background, mask=share) for view, background, share in shown]
    none = torch.zeros(0)
    unknown = torch.full((2, config.size, config.size), torch.nan)
    return Item(
        keys=keys,
        notes=notes,
        images=sources.images,
        masks=sources.masks[:, None],
        uv=sources.uv,
        weights=inputs.weights[0],
        labels=torch.stack([unknown if view.uv is None else view.uv for view in sources.views]),
        points=surface.points[0],
        quats=surface.quats[0],
        scales=surface.scales[0],
        prior=none if surface.prior is None else surface.prior,
        lift=none if surface.lift is None else surface.lift,
        shape=none if surface.shape is None else surface.shape,
        canonical=shaped_vertices(head, HeadParameters.zeros(head).replace(identity=identity), fit.static_offset),
        posed=posed,
        viewmats=cameras.viewmat,
        Ks=cameras.K,
        pictures=torch.stack(pictures),
        coverage=coverage,
        person=person,
        backgrounds=backgrounds.contiguous(),
        texture=texture,
        relief=surface.points[0] if sources.exact else true_surface(targets[0], head, fit, config.model.map_size),
        driving=driving(views, head) if config.model.canonical == "template" else None,
    )


def _labelled(
    photos: list[View], notes: tuple[str, ...], config: TrainConfig, head: HeadModel, random: np.random.Generator
) -> Item:
    """Photos with the exact correspondence of their pixels."""
    shared = draw_grade(random) if config.augment else Grade()
    for view in photos:
        if view.uv is None:
            view.uv = tracked_uv(view, head)
        view.image = shared(view.image)
    shown = [view.image for view in photos]
    if config.augment:
        for view in photos:
            view.jitter(random)
        shown = [degrade(draw_grade(random, GRADE_BETWEEN)(view.image), random) for view in photos]
    background = torch.full((3,), config.backgrounds[random.integers(len(config.backgrounds))])
    images = torch.stack([view.over(background, image) for view, image in zip(photos, shown, strict=True)])
    masks = torch.stack([view.mask for view in photos])[:, None]
    labels = torch.stack([view.uv for view in photos if view.uv is not None])
    keys = tuple(view.key for view in photos)
    return Item(keys, notes, images, masks, labels, masks, labels, *(torch.zeros(0),) * 16)


def _choose(
    person: Person,
    sources: int,
    targets: int,
    config: TrainConfig,
    random: np.random.Generator,
    head: HeadModel,
    found: Callable[[View], bool] = lambda _: True,
) -> tuple[list[View], list[View]]:
    """Photos turned to the camera as far as `config.facing` asks, and pictures of any side; too few are used twice.

    A photo is one in which the face is `found`; there may be fewer than asked for, but for one.

    Raises:
        DataError: the face is found in none.
    """
    order = random.permutation(len(person))
    photos: list[View] = []
    others: list[View] = []
    for index in order.tolist():
        if len(photos) == sources and len(others) >= targets:
            break
        view = View(person.sample(index), config.size, head)
        seen = len(photos) < sources and _facing(view) >= config.facing and found(view)
        (photos if seen else others).append(view)
    if not photos:
        others.sort(key=_facing)
        photos.append(others.pop())
        if not found(photos[0]):
            raise DataError(f"{photos[0].key}: no face is found in any picture of this person")
    pictures = others[:targets]
    again = [View(person.sample(order[k % len(order)]), config.size, head) for k in range(targets - len(pictures))]
    return photos, [*pictures, *again]


def _facing(view: View) -> float:
    """Cosine between the direction of the face and that to the camera."""
    if view.parameters is None:
        return 1.0
    turn = rodrigues(view.parameters.rotation) @ rodrigues(view.parameters.neck)
    away = view.camera.position - view.parameters.translation
    return float(turn[:, 2] @ away / away.norm())
