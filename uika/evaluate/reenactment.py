"""Avatars from source frames, and pictures of them in the place of target frames."""

from __future__ import annotations

import tempfile
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from uika.avatar import Avatar
from uika.avatar.rendering import render
from uika.data import Sample
from uika.data.views import View
from uika.evaluate.protocol import Protocol
from uika.evaluate.sequences import check_sample
from uika.fitting import Fit
from uika.head import Camera, HeadModel, HeadParameters, pose_vertices
from uika.head.alignment import aligned_camera
from uika.io.files import replacing
from uika.io.video import to_bytes
from uika.reconstruction import (
    MAX_PHOTOS,
    LoadedModel,
    PreparedPhoto,
    Report,
    avatar_from_fit,
    fit_prepared,
    prepare_file,
)

_PHOTO_SIDE = 512  # pixels of photos for networks that take any


class Observed(NamedTuple):
    """What is known of N source frames, in the order that `avatar_from_fit` takes it."""

    fit: Fit | None  # None for a model that needs none
    images: Tensor  # [N,3,S,S] on white
    mattes: Tensor  # [N,S,S]
    digests: list[str]


class Cutouts:
    """Source frames as photos that know nothing but pixels and matte, prepared once for all avatars that they serve."""

    def __init__(self) -> None:
        """Nothing is known yet."""
        self._known: OrderedDict[tuple[str, str], PreparedPhoto] = OrderedDict()

    def photo(self, sample: Sample) -> PreparedPhoto:
        """Prepare a frame, or remember it.

        Raises:
            PhotoError: it shows no face that can be found.
        """
        name = sample.identity, sample.key
        if name not in self._known:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / f"{sample.key}.png"
                _write_cutout(path, sample)
                self._known[name] = prepare_file(path)
        self._known.move_to_end(name)
        while len(self._known) > MAX_PHOTOS:
            self._known.popitem(last=False)
        return self._known[name]


def observe_sources(
    sources: Sequence[Sample],
    correspondence: str,
    size: int,
    head: HeadModel,
    cutouts: Cutouts | None = None,
    loaded: LoadedModel | None = None,
) -> Observed:
    """Heads and cameras of source frames: by landmark fits of the pictures ("fit") or their true ones ("exact").

    Args:
        sources: N frames of one person.
        correspondence: "fit" or "exact".
        size: pixels of a side of the photos; fits decide by themselves.
        head: the head model.
        cutouts: what was prepared before.
        loaded: the model that they are for.

    Raises:
        PhotoError: a source shows no face that can be found.
        DataError: a source lacks the head parameters that "exact" needs.
    """
    if correspondence == "fit":
        cutouts = cutouts or Cutouts()
        found = fit_prepared([cutouts.photo(sample) for sample in sources], head, loaded=loaded)
        return Observed(found.fit, found.images, found.mattes, found.digests)
    for sample in sources:
        check_sample(sample, head)
    views = [View(sample, size, head) for sample in sources]
    parameters = HeadParameters.stack([_parameters(view) for view in views])
    fit = Fit(parameters, Camera.stack([v.camera for v in views]), _offset(views[0], head), torch.zeros(len(views)))
    images = torch.stack([view.over(torch.ones(3)) for view in views])
    return Observed(fit, images, torch.stack([view.mask for view in views]), [view.key for view in views])


def make_avatar(
    sources: Sequence[Sample],
    loaded: LoadedModel,
    correspondence: str,
    head: HeadModel,
    cutouts: Cutouts | None = None,
) -> Avatar:
    """Reconstruct from source frames; raises as `observe_sources` does."""
    size = loaded.network.config.image_size or _PHOTO_SIDE
    if correspondence == "exact":
        loaded = loaded._replace(estimator=None)
    observed = observe_sources(sources, correspondence, size, head, cutouts, loaded)
    return avatar_from_fit(loaded, head, *observed, Report(), photo_splats=False)


def drive(avatar: Avatar, targets: Sequence[View], head: HeadModel, background: float) -> list[Tensor]:
    """Pictures [S,S,3] of the avatar with the pose, expression and camera of each target, rounded to 8 bits."""
    canonical = avatar.canonical_vertices(head)
    pictures = []
    for view in targets:
        params = _parameters(view).replace(identity=avatar.identity)
        truth = pose_vertices(head, _parameters(view), _offset(view, head))
        camera = view.camera
        if avatar.skinning == "surface":
            # The avatar's own surface tells its size; on the template the Gaussians' offsets do, and need no help.
            own = pose_vertices(head, params, avatar.static_offset)
            camera = aligned_camera(own, truth, head.masks["face"], camera)
        pictures.append(rounded(render(avatar, params, camera, head, [background] * 3, canonical=canonical).rgb))
    return pictures


def target_views(samples: Sequence[Sample], protocol: Protocol, head: HeadModel) -> list[View]:
    """Targets, squared and resized as the protocol says.

    Raises:
        DataError: one has no parameters of this head model.
    """
    for sample in samples:
        check_sample(sample, head)
    return [View(sample, protocol.size, head) for sample in samples]


def truth_picture(view: View, background: float) -> Tensor:
    """A target [S,S,3] on the protocol's background, rounded to 8 bits."""
    return rounded(view.over(torch.full((3,), background)).permute(1, 2, 0))


def rounded(picture: Tensor) -> Tensor:
    """The picture as an 8-bit file would keep it."""
    return torch.from_numpy(to_bytes(picture).astype(np.float32) / 255)


def _write_cutout(path: Path, sample: Sample) -> None:
    from PIL import Image

    view = View(sample, max(sample.mask.shape))
    planes = torch.cat((view.image, view.mask[None])).permute(1, 2, 0)
    with replacing(path) as temporary:
        Image.fromarray(to_bytes(planes)).save(temporary)


def _parameters(view: View) -> HeadParameters:
    assert view.parameters is not None  # check_sample
    return view.parameters


def _offset(view: View, head: HeadModel) -> Tensor:
    return torch.zeros_like(head.template) if view.static_offset is None else view.static_offset
