"""One head of one step: photos as the model will meet them in use, and pictures to compare its result with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from uika.canonical.surface import surface_texels
from uika.data import DataError
from uika.data.datasets import People, Person, left_out
from uika.data.labels import check_parameters, tracked_uv
from uika.data.texture import true_texture
from uika.data.views import View
from uika.fitting import Fit, fit_photos, pixel_uv
from uika.head import Camera, HeadModel, HeadParameters, load_head, pose_vertices, project, rodrigues, shaped_vertices
from uika.head.alignment import align, aligned_camera
from uika.reconstruction.model_inputs import model_inputs
from uika.train.augment import degrade, draw_grade
from uika.train.config import TrainConfig
from uika.train.sampler import Draw

_TRIES = 3  # people tried in the place of one that cannot be read
_BACKGROUNDS = (0.0, 0.5, 1.0)  # grey levels behind pictures to compare with
_GRADE_BETWEEN = 0.15  # strength of the grades in which photos of one head differ
_LANDMARK_BIAS, _LANDMARK_NOISE = 0.012, 0.008  # of a simulated detector, in widths of the face
_FACE_MESH_POINTS = 478


@dataclass(frozen=True, eq=False)
class Item:
    """One head with V photos and D pictures of S*S pixels; M Gaussians, N vertices. Everything float32."""

    keys: tuple[str, ...]  # of the images it was made from
    notes: tuple[str, ...]  # what could not be read and was replaced, or is not used; mostly empty
    images: Tensor  # [V,3,S,S] photos on one colour
    masks: Tensor  # [V,1,S,S]
    uv: Tensor  # [V,2,S,S], NaN where unknown
    weights: Tensor  # [V,1,S,S]
    labels: Tensor  # [V,2,S,S] exact correspondences, NaN where unknown
    points: Tensor  # [M,3] surface; empty for the estimator, as all below
    quats: Tensor  # [M,4]
    scales: Tensor  # [M,3]
    prior: Tensor  # [3,A,A] supposed colours of the atlas
    lift: Tensor  # [1,A,A] metres of hair over the bald head
    shape: Tensor  # [3,A,A] metres off the mean head
    canonical: Tensor  # [N,3] vertices
    posed: Tensor  # [D,N,3] vertices
    viewmats: Tensor  # [D,4,4]
    Ks: Tensor  # [D,3,3]
    pictures: Tensor  # [D,3,S,S] on the colours of `backgrounds`
    coverage: Tensor  # [D,1,S,S]
    backgrounds: Tensor  # [D,3]
    texture: Tensor  # [4,A,A] true colours of the atlas and where they are known; empty if nowhere
    relief: Tensor  # [M,3] where the true surface lies, in the frame of `points`
    driving: HeadParameters | None = None  # [D] of the pictures with the mean identity, for models on the template

    def to(self, device: torch.device) -> Item:
        """A copy on another device."""
        moved: dict[str, Any] = {name: v.to(device) for name, v in vars(self).items() if isinstance(v, Tensor)}
        return replace(self, **moved, driving=None if self.driving is None else self.driving.to(device=device))


class ItemMaker(torch.utils.data.Dataset[Item]):
    """Draws -> items; the same draw always makes the same item, in whichever process."""

    def __init__(self, people: People, config: TrainConfig) -> None:
        """`people` must survive pickling."""
        self._people, self._config = people, config

    def __getitem__(self, draw: Draw) -> Item:
        """Make one item.

        Raises:
            DataError: several people in a row cannot be used.
        """
        notes: list[str] = []
        for attempt in range(_TRIES):
            person = (draw.person + attempt) % len(self._people)
            try:
                return self._make(self._people[person], draw, notes)
            except DataError as error:
                notes.append(f"replaced: {error}")
        first = notes[0].removeprefix("replaced: ")
        raise DataError(f"{_TRIES} people in a row cannot be used; the first: {first}")

    def _make(self, person: Person, draw: Draw, replaced: list[str]) -> Item:
        notes = (*replaced, *left_out(person))
        random = np.random.default_rng(draw.seed)
        config, head = self._config, load_head().without_bust
        extra = config.atlas_views if config.losses.atlas else 0
        wanted = config.targets + extra if config.part == "reconstructor" else 0
        photos, pictures = _choose(person, draw.sources, wanted, config, head, random)
        for view in (*photos, *pictures):
            _check(view, head, config)
        on_template = config.model.canonical == "template"
        fitted = config.part == "reconstructor" and not on_template and random.random() < config.fitted
        if config.augment:
            shared = draw_grade(random)
            for view in (*photos, *pictures):
                view.image = shared(view.image)
        texture = torch.zeros(0)
        if config.losses.atlas and config.part == "reconstructor":
            texture = true_texture((*photos, *pictures), config.model.map_size)
            pictures = pictures[: config.targets]
        if config.augment:
            for view in photos:
                view.jitter(random)
                view.image = degrade(draw_grade(random, _GRADE_BETWEEN)(view.image), random)
        grey = config.backgrounds[random.integers(len(config.backgrounds))]
        images = torch.stack([view.over(torch.full((3,), grey)) for view in photos])
        masks = torch.stack([view.mask for view in photos])
        unknown = torch.full((2, config.size, config.size), torch.nan)
        labels = torch.stack([unknown if view.uv is None else view.uv for view in photos])
        keys = tuple(view.key for view in (*photos, *pictures))
        none = torch.zeros(0)
        if config.part == "estimator":
            return Item(keys, notes, images, masks[:, None], labels, masks[:, None], labels, *(none,) * 15)
        fit = _fit(photos, masks, head, random) if fitted else _exact(photos, head)
        uv, valid, weight = pixel_uv(fit, head, masks)
        uv = torch.where(valid[..., None], uv, torch.nan).permute(0, 3, 1, 2)
        if not fitted:
            # Glasses hide what the surface alone would show; a fit does not know that.
            weight = weight * torch.isfinite(labels[:, 0]) if bool(torch.isfinite(labels).any()) else weight
        identity = fit.parameters.identity[0]
        inputs, _ = model_inputs(config.model, head, identity, fit.static_offset, images, masks, uv, weight)
        surface = inputs.surface
        posed, cameras = _poses(pictures, head, fit if fitted else None)
        backgrounds = torch.from_numpy(random.choice(_BACKGROUNDS, len(pictures))).float()[:, None].expand(-1, 3)
        return Item(
            keys=keys,
            notes=notes,
            images=images,
            masks=masks[:, None],
            uv=uv,
            weights=inputs.weights[0],
            labels=labels,
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
            pictures=torch.stack([view.over(back) for view, back in zip(pictures, backgrounds, strict=True)]),
            coverage=torch.stack([view.mask for view in pictures])[:, None],
            backgrounds=backgrounds.contiguous(),
            texture=texture,
            relief=_relief(photos[0], head, fit, config.model.map_size) if fitted else surface.points[0],
            driving=_driving(pictures, head) if on_template else None,
        )


def _choose(
    person: Person, sources: int, targets: int, config: TrainConfig, head: HeadModel, random: np.random.Generator
) -> tuple[list[View], list[View]]:
    """Photos turned to the camera as far as `config.facing` asks, and pictures of any side; too few are used twice."""
    order = random.permutation(len(person))
    photos: list[View] = []
    others: list[View] = []
    for index in order.tolist():
        if len(photos) == sources and len(others) >= targets:
            break
        view = View(person.sample(index), config.size, head)
        (photos if len(photos) < sources and _facing(view) >= config.facing else others).append(view)
    if not photos:
        others.sort(key=_facing)
        photos.append(others.pop())
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


def _check(view: View, head: HeadModel, config: TrainConfig) -> None:
    if config.part == "estimator":
        if view.uv is None:
            view.uv = tracked_uv(view, head)
        return
    check_parameters(view, head)


def _exact(photos: list[View], head: HeadModel) -> Fit:
    """The truth in the shape of a fit."""
    parameters = HeadParameters.stack([_parameters(view) for view in photos])
    return Fit(
        parameters, Camera.stack([view.camera for view in photos]), _offset(photos[0], head), torch.zeros(len(photos))
    )


def _fit(photos: list[View], masks: Tensor, head: HeadModel, random: np.random.Generator) -> Fit:
    """What the landmark fit makes of the photos, with landmarks as a detector might find them."""
    found = []
    for view, mask in zip(photos, masks, strict=True):
        vertices = pose_vertices(head, _parameters(view), _offset(view, head))
        pixels, _ = project(head.landmarks(vertices), view.camera)
        width = pixels[:, 0].max() - pixels[:, 0].min()
        bias = _LANDMARK_BIAS * _smooth_noise(head, random)
        noise = torch.from_numpy(random.normal(0, _LANDMARK_NOISE, (len(pixels), 2))).float()
        landmarks = torch.zeros(_FACE_MESH_POINTS, 2)
        landmarks[head.landmark_ids] = pixels + width * (bias + noise)
        found.append(_Photo(landmarks, mask))
    return fit_photos(found, head, [photo.matte for photo in found], correct_detector=False)


@dataclass(frozen=True, eq=False)
class _Photo:
    landmarks: Tensor
    matte: Tensor


def _smooth_noise(head: HeadModel, random: np.random.Generator) -> Tensor:
    """Errors [L,2] of deviation 1 that neighbouring landmarks share."""
    place = head.landmarks(head.template) / 0.05  # wavelengths of a face's features
    waves = torch.from_numpy(random.normal(size=(4, 3))).float()
    phases = torch.from_numpy(random.uniform(0, 2 * np.pi, 4)).float()
    mixture = torch.from_numpy(random.normal(size=(4, 2))).float()
    return torch.cos(place @ waves.mT + phases) @ mixture * (2 / 4) ** 0.5


def _relief(view: View, head: HeadModel, fit: Fit, size: int) -> Tensor:
    """The true canonical surface [M,3] at the texels, moved and scaled to where a fit has the face."""
    identity, offset = _parameters(view).identity, _offset(view, head)
    zero = HeadParameters.zeros(head)
    truth = shaped_vertices(head, zero.replace(identity=identity), offset)
    own = shaped_vertices(head, zero.replace(identity=fit.parameters.identity[0]), fit.static_offset)
    scale, rotation, shift = align(truth, own, head.masks["face"])
    points = surface_texels(head, identity, offset, size)[0].points[0].double()
    return (scale * points @ rotation.mT + shift).float()


def _poses(pictures: list[View], head: HeadModel, fit: Fit | None) -> tuple[Tensor, Camera]:
    """Posed vertices [D,N,3] and cameras [D] of the pictures; a fitted head is put where the true one is."""
    posed, cameras = [], []
    for view in pictures:
        truth = _parameters(view)
        vertices, camera = pose_vertices(head, truth, _offset(view, head)), view.camera
        if fit is not None:
            own = pose_vertices(head, truth.replace(identity=fit.parameters.identity[0]), fit.static_offset)
            camera = aligned_camera(own, vertices, head.masks["face"], camera)
            vertices = own
        posed.append(vertices)
        cameras.append(camera)
    return torch.stack(posed), Camera.stack(cameras)


def _driving(pictures: list[View], head: HeadModel) -> HeadParameters:
    """Expressions and poses [D] of pictures, with the mean identity."""
    mean = torch.zeros(len(head.identity_basis))
    return HeadParameters.stack([_parameters(view).replace(identity=mean) for view in pictures])


def _parameters(view: View) -> HeadParameters:
    assert view.parameters is not None  # _check
    return view.parameters


def _offset(view: View, head: HeadModel) -> Tensor:
    return torch.zeros_like(head.template) if view.static_offset is None else view.static_offset
