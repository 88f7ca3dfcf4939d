"""What the photos show outside the fitted surface, added to an avatar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from uika.avatar import Avatar
from uika.head import Camera, HeadModel, HeadParameters
from uika.photo_splats import PhotoView, frontal, with_photo_splats
from uika.reconstruction.bust import joined_parameters, wider_camera
from uika.reconstruction.fitted_photos import FittedPhotos
from uika.reconstruction.report import Report

if TYPE_CHECKING:
    from uika.photo import Photo


def with_outside(
    avatar: Avatar,
    head: HeadModel,
    groups: Sequence[FittedPhotos],
    report: Report,
    poses: HeadParameters | None = None,
) -> Avatar:
    """The avatar with photo splats, whose number its provenance tells.

    Args:
        avatar: the surface as splats.
        head: its head model.
        groups: photos, group by group, fitted with one identity.
        report: gets the time and the count.
        poses: [N] of head and bust in the photos; None takes those of the fits.
    """
    fitted = [(group, group.fit) for group in groups if group.fit is not None]
    poses = joined_parameters([fit for _, fit in fitted]) if poses is None else poses
    cameras = [fit.cameras[n] for group, fit in fitted for n in range(len(group.photos))]
    shown = [each for group, _ in fitted for each in zip(group.images, group.mattes, group.hairs, strict=True)]
    views = [PhotoView(poses[n], camera, *shown[n]) for n, camera in enumerate(cameras)]
    front = frontal(views)
    photo = [photo for group, _ in fitted for photo in group.photos][front]
    body = None if head.bust is None or photo.bust is None else _body_view(views[front], photo)
    return with_views(avatar, head, views, report, body)


def with_views(
    avatar: Avatar, head: HeadModel, views: Sequence[PhotoView], report: Report, body: PhotoView | None = None
) -> Avatar:
    """The same for views at hand; `body` is a wider crop of the most frontal one, see `with_photo_splats`."""
    with report.stage("photo splats"):
        result = with_photo_splats(avatar, head, views, body=body)
    count = len(result) - len(avatar)
    report.counts["photo_splats"] = count
    return replace(result, provenance={**avatar.provenance, "photo_splats": str(count)})


def _body_view(view: PhotoView, photo: Photo) -> PhotoView:
    """The photo's wider crop, with the head's matte where the narrower one has it."""
    assert photo.bust is not None
    hair = resampled(view.hair, view.camera, wide := wider_camera(view.camera, photo))
    return PhotoView(view.parameters, wide, photo.bust.image, photo.bust.matte, torch.minimum(hair, photo.bust.matte))


def resampled(values: Tensor, camera: Camera, other: Camera) -> Tensor:
    """Values [S,S] of a picture in the pixels [T,T] of another camera at the same place, 0 beyond the picture."""
    change = camera.K @ torch.linalg.inv(other.K)
    at = torch.arange(other.width) + 0.5
    column, row = at * change[0, 0] + change[0, 2], at * change[1, 1] + change[1, 2]
    grid = torch.stack(torch.broadcast_tensors(column[None, :], row[:, None]), -1) / camera.width * 2 - 1
    return grid_sample(values[None, None], grid[None], align_corners=False)[0, 0]
