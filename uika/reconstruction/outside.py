"""What the photos show outside the fitted surface, added to an avatar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from uika.avatar import Avatar
from uika.head import HeadModel, HeadParameters
from uika.photo_splats import PhotoView, with_photo_splats
from uika.reconstruction.bust import joined_parameters
from uika.reconstruction.fitted_photos import FittedPhotos
from uika.reconstruction.report import Report


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
    return with_views(
        avatar, head, [PhotoView(poses[n], camera, *shown[n]) for n, camera in enumerate(cameras)], report
    )


def with_views(avatar: Avatar, head: HeadModel, views: Sequence[PhotoView], report: Report) -> Avatar:
    """The same for views whose poses, pictures and mattes are at hand."""
    with report.stage("photo splats"):
        result = with_photo_splats(avatar, head, views)
    count = len(result) - len(avatar)
    report.counts["photo_splats"] = count
    return replace(result, provenance={**avatar.provenance, "photo_splats": str(count)})
