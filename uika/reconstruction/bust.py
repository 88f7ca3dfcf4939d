"""The bust added to an avatar of a head: fitted to the photos' wider crops and splatted with their colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import torch

from uika.avatar import Avatar
from uika.canonical.bust import BustView, bust_splats
from uika.head import Binding, Camera, HeadModel, HeadParameters, pose_vertices
from uika.reconstruction.report import Report
from uika.reconstruction.sharpening import sharpened

if TYPE_CHECKING:
    from uika.fitting import Fit
    from uika.photo import Photo


@torch.no_grad()
def with_bust(
    avatar: Avatar, head: HeadModel, fits: Sequence[Fit], photos: Sequence[Photo], report: Report
) -> tuple[Avatar, HeadParameters]:
    """The avatar of a head with a bust below it, and the poses [N] of both in the photos.

    Args:
        avatar: made for `head.without_bust`.
        head: the head model with its bust.
        fits: of the photos, group by group, with one identity.
        photos: N photos in the order of the fits, prepared with `bust`.
        report: gets the time.
    """
    from uika.fitting.torso import fit_torso, torso_parameters

    with report.stage("bust"):
        crops = [photo.bust for photo in photos if photo.bust is not None]
        mattes, inside = (torch.stack([getattr(crop, name) for crop in crops]) for name in ("matte", "inside"))
        parameters = joined_parameters(fits)
        cameras = Camera.stack(
            [wider_camera(camera, photo) for camera, photo in zip(_single(fits), photos, strict=True)]
        )
        found = fit_torso(head, parameters, fits[0].static_offset, cameras, mattes, inside)
        poses = torso_parameters(head, parameters, found.turns)
        vertices = pose_vertices(head, poses, found.offset)
        order = sorted(range(len(crops)), key=lambda n: float(cameras.viewmat[n, 2, 2]))
        views = [BustView(vertices[n], cameras[n], crops[n].image, crops[n].matte, crops[n].inside) for n in order]
        neck = Binding(0, avatar.triangle, avatar.triangle, avatar.barycentric), avatar.colors
        bust = bust_splats(head, avatar.identity, found.offset, views, neck)
        names = ("means", "quats", "scales", "opacities", "colors", "triangle", "barycentric")
        joined: dict[str, Any] = {name: torch.cat((getattr(avatar, name), getattr(bust, name))) for name in names}
        result = replace(
            avatar,
            head_id=head.id,
            bust_triangle=None if head.bust is None else head.bust.face,
            static_offset=found.offset,
            **joined,
        )
        front = order[0]
        known = torch.minimum(crops[front].matte, crops[front].inside)
        lit = poses[front], cameras[front], crops[front].image
        result = sharpened(result, head, *lit, known, result.on_bust, relit=len(order) > 1)
    return result, poses


def joined_parameters(fits: Sequence[Fit]) -> HeadParameters:
    """The parameters [N] of the photos of several fits."""
    return HeadParameters(
        **{f.name: torch.cat([getattr(fit.parameters, f.name) for fit in fits]) for f in fields(HeadParameters)}
    )


def _single(fits: Sequence[Fit]) -> list[Camera]:
    return [fit.cameras[n] for fit in fits for n in range(len(fit.error))]


def wider_camera(camera: Camera, photo: Photo) -> Camera:
    """The camera of a photo's wider crop."""
    assert photo.bust is not None
    size = photo.bust.matte.shape[-1]
    x0, y0, side = photo.bust.crop
    scale = photo.crop[2] / camera.width * size / side
    shift = [(photo.crop[0] - x0) * size / side, (photo.crop[1] - y0) * size / side]
    change = torch.tensor([[scale, 0.0, shift[0]], [0.0, scale, shift[1]], [0.0, 0.0, 1.0]])
    return Camera(camera.viewmat, change @ camera.K, size, size)
