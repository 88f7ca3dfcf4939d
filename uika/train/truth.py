"""What is known of a head that a network has to find: surface, poses, and what splats can show of it at best."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from uika.canonical.surface import surface_texels
from uika.data.views import View
from uika.fitting import Fit
from uika.head import Camera, HeadModel, HeadParameters, pose_gaussians, pose_vertices, shaped_vertices
from uika.head.alignment import align, aligned_camera


def exact_fit(photos: Sequence[View], head: HeadModel) -> Fit:
    """The truth in the shape of a fit."""
    parameters = HeadParameters.stack([parameters_of(view) for view in photos])
    cameras = Camera.stack([view.camera for view in photos])
    return Fit(parameters, cameras, offset_of(photos[0], head), torch.zeros(len(photos)))


def true_surface(view: View, head: HeadModel, fit: Fit, size: int) -> Tensor:
    """The true canonical surface [M,3] at the texels, moved and scaled to where a fit has the face."""
    identity, offset = parameters_of(view).identity, offset_of(view, head)
    zero = HeadParameters.zeros(head)
    truth = shaped_vertices(head, zero.replace(identity=identity), offset)
    own = shaped_vertices(head, zero.replace(identity=fit.parameters.identity[0]), fit.static_offset)
    scale, rotation, shift = align(truth, own, head.masks["face"])
    points = surface_texels(head, identity, offset, size)[0].points[0].double()
    return (scale * points @ rotation.mT + shift).float()


def poses_in(pictures: Sequence[View], head: HeadModel, fit: Fit | None) -> tuple[Tensor, Camera]:
    """Posed vertices [D,N,3] and cameras [D] of pictures; a fitted head is put where the true one is."""
    posed, cameras = [], []
    for view in pictures:
        truth = parameters_of(view)
        vertices, camera = pose_vertices(head, truth, offset_of(view, head)), view.camera
        if fit is not None:
            own = pose_vertices(head, truth.replace(identity=fit.parameters.identity[0]), fit.static_offset)
            camera = aligned_camera(own, vertices, head.masks["face"], camera)
            vertices = own
        posed.append(vertices)
        cameras.append(camera)
    return torch.stack(posed), Camera.stack(cameras)


@torch.no_grad()
def true_coverage(pictures: Sequence[View], head: HeadModel, size: int, opacity: float) -> Tensor:
    """Coverage [D,1,S,S] of the true surface as splats, one for each texel of an atlas of `size`.

    Splats reach past the outline of the surface that they lie on. Held against a mask, even exact ones would be best
    drawn in; held against this, the true surface is the best one.
    """
    from drjit_splat import rasterization

    first = pictures[0]
    identity, offset = parameters_of(first).identity, offset_of(first, head)
    surface, binding = surface_texels(head, identity, offset, size)
    canonical = shaped_vertices(head, HeadParameters.zeros(head).replace(identity=identity), offset)
    count = len(binding)
    colors, opacities = torch.zeros(count, 3), torch.full((count,), opacity)
    result = []
    for view in pictures:
        posed = pose_vertices(head, parameters_of(view), offset)
        splats = (surface.points[0], surface.quats[0], surface.scales[0])
        places = (canonical, posed, head.faces, binding.triangle, binding.barycentric)
        side = view.mask.shape[-1]
        placed = pose_gaussians(*splats, *places)
        camera = (view.camera.viewmat[None], view.camera.K[None])
        _, alpha, _ = rasterization(*placed, opacities, colors, *camera, side, side)
        result.append(alpha[0].permute(2, 0, 1))
    return torch.stack(result)


def driving(pictures: Sequence[View], head: HeadModel) -> HeadParameters:
    """Expressions and poses [D] of pictures, with the mean identity."""
    mean = torch.zeros(len(head.identity_basis))
    return HeadParameters.stack([parameters_of(view).replace(identity=mean) for view in pictures])


def parameters_of(view: View) -> HeadParameters:
    """The parameters of a view that was checked to have them."""
    assert view.parameters is not None
    return view.parameters


def offset_of(view: View, head: HeadModel) -> Tensor:
    """The displacement [V,3] of a view's neutral head, metres."""
    return torch.zeros_like(head.template) if view.static_offset is None else view.static_offset
