"""Photos of one person, and the heads and cameras fitted to them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from uika.head import HeadModel
from uika.head.light import COUNT
from uika.reconstruction.report import Report

if TYPE_CHECKING:
    from uika.fitting import Fit
    from uika.photo import Photo
    from uika.reconstruction.models import LoadedModel


class PreparedPhoto(NamedTuple):
    """A photo and the matte [S,S] of its head and hair."""

    photo: Photo
    hair: Tensor


class FittedPhotos(NamedTuple):
    """N photos of one person and the heads and cameras fitted to them."""

    photos: tuple[Photo, ...]
    fit: Fit | None  # None for a model that needs none
    images: Tensor  # [N,3,S,S] on one plain colour
    mattes: Tensor  # [N,S,S] in [0,1]
    digests: list[str]  # of the files
    hairs: Tensor  # [N,S,S] mattes of head and hair, in [0,1]


def fit_files(
    photos: Sequence[str | Path],
    head: HeadModel,
    *,
    refine: bool = True,
    report: Report | None = None,
    loaded: LoadedModel | None = None,
    bust: bool = False,
) -> FittedPhotos:
    """Read photos of one person and fit the head to them; they come out in the order of their content hashes.

    With `bust`, the photos keep a wider crop of the shoulders too.

    Raises:
        PhotoError: a photo cannot be read or shows no face; the message names it.
    """
    report = Report() if report is None else report
    with report.stage("photos"):
        prepared = prepare_files(photos, bust=bust)
    return fit_prepared(prepared, head, refine=refine, report=report, loaded=loaded)


def prepare_files(paths: Sequence[str | Path], *, bust: bool = False) -> list[PreparedPhoto]:
    """`prepare_file` of each, several at once on a machine with several cores; in the order of the paths.

    Raises:
        PhotoError: one cannot be read or shows no face; the first such in order is named.
    """
    if len(paths) == 1:
        return [prepare_file(paths[0], bust=bust)]
    with ThreadPoolExecutor(min(len(paths), os.cpu_count() or 1)) as pool:
        waiting = [pool.submit(prepare_file, path, bust=bust) for path in paths]
        try:
            return [each.result() for each in waiting]
        except BaseException:
            for each in waiting:
                each.cancel()
            raise


def prepare_file(path: str | Path, *, bust: bool = False) -> PreparedPhoto:
    """All that a photo needs before it is fitted together with others; with `bust`, its shoulders too.

    Raises:
        PhotoError: it cannot be read or shows no face; the message names it.
    """
    from uika.photo import head_matte, prepare

    photo = prepare(path, bust=bust)
    return PreparedPhoto(photo, head_matte(photo))


def fit_prepared(
    prepared: Sequence[PreparedPhoto],
    head: HeadModel,
    *,
    refine: bool = True,
    report: Report | None = None,
    known: Fit | None = None,
    loaded: LoadedModel | None = None,
) -> FittedPhotos:
    """Fit the head to prepared photos of one person; they come out in the order of their content hashes.

    Args:
        prepared: N photos.
        head: the head model.
        refine: whether to refine the fit with the colours that the photos share.
        report: gets the time.
        known: an earlier fit of the person, whose identity and hair are kept.
        loaded: the model that they are for; None fits the head and leaves the photos as they are.
    """
    report = Report() if report is None else report
    ordered = sorted(prepared, key=lambda each: each.photo.sha256)
    photos = [each.photo for each in ordered]
    fit = None
    if loaded is None or loaded.needs_fit:
        from uika.fitting import fit_photos

        with report.stage("fit"):
            pictures = [photo.image for photo in photos] if refine else None
            focals = [photo.focal for photo in photos]
            marks = None
            if loaded is not None and loaded.sight is not None:
                from uika.reconstruction.surface_marks import surface_marks

                shown = torch.stack([photo.image for photo in photos]), torch.stack([photo.matte for photo in photos])
                marks = surface_marks(loaded.sight, head, *shown)
            found = [each.hair for each in ordered]
            bounds = [photo.bounds for photo in photos]
            fit = fit_photos(
                photos, head, found, images=pictures, focals=focals, known=known, marks=marks, bounds=bounds
            )
    pairs = [(photo.image, photo.matte) for photo in photos]
    if loaded is not None and loaded.released is not None:
        pairs = [released_view(photo) for photo in photos]
    images, mattes = (torch.stack(parts) for parts in zip(*pairs, strict=True))
    hairs = torch.stack([each.hair for each in ordered])
    return FittedPhotos(tuple(photos), fit, images, mattes, [photo.sha256 for photo in photos], hairs)


def released_view(photo: Photo) -> tuple[Tensor, Tensor]:
    """A photo [3,512,512] and mask [512,512] as the released program hands them to its network."""
    from uika.photo.square_view import prepare_reference

    return prepare_reference(photo.original.permute(1, 2, 0).numpy(), photo.matte.numpy())


def photo_light(path: str | Path, head: HeadModel) -> Tensor:
    """The light [9,3] on the face in a photo of anyone, as `uika.head.light` has it; its mean is white.

    Raises:
        PhotoError: the photo cannot be read or shows no face; the message names it.
    """
    from uika.canonical.light import absolute_light, sample_light
    from uika.fitting import pixel_uv

    head = head.without_bust
    found = fit_files([path], head)
    fit = found.fit
    assert fit is not None
    uv, valid, weight = pixel_uv(fit, head, found.mattes)
    places = torch.where(valid[..., None], uv, torch.nan).permute(0, 3, 1, 2)
    identity = fit.parameters.identity[0]
    sample = sample_light(head, identity, fit.static_offset, found.images, places, weight[:, None])
    return absolute_light(sample, torch.zeros(1, COUNT, 3), 0)
