"""From a fitted head to pixel-wise correspondence: the UV coordinate that each foreground pixel shows (paper 3.1)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from uika.fitting.fit import Fit
from uika.fitting.part_trust import lid_doubt, opening_trust
from uika.fitting.weights import PIXEL_FACING, PIXEL_GRAZING
from uika.head import HeadModel, pose_vertices, project, rasterize, vertex_normals

SURE_MATTE, FULL_MATTE = 0.7, 0.98  # matte values between which a pixel gains weight: edges carry background light
EDGE = 2  # pixels inside the matte's edge that are not trusted


def pixel_uv(fit: Fit, head: HeadModel, mattes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rasterize the fitted head into each photo; the nearest front-facing surface wins.

    Args:
        fit: the fit of N photos.
        head: the head model it was made with.
        mattes: [N,S,S] person mattes in [0,1]; S must be the size the cameras were fitted for.

    Returns:
        uv [N,S,S,2] in [0,1] with v measured from the top (0 where nothing is hit), valid [N,S,S] bool,
        weight [N,S,S] in [0,1]: trust from the matte and the viewing angle, 0 where not valid.
    """
    head = head.without_bust
    size = fit.cameras.width
    if mattes.shape[1:] != (size, fit.cameras.height) or len(mattes) != len(fit.error):
        raise ValueError(f"mattes: need [{len(fit.error)},{fit.cameras.height},{size}], got {tuple(mattes.shape)}")
    corner_uv = head.uvs[head.uv_faces] * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1.0])
    vertices = pose_vertices(head, fit.parameters, fit.static_offset)
    uv, valid, weight = [], [], []
    for n, matte in enumerate(mattes):
        camera = fit.cameras[n]
        points, depth = project(vertices[n], camera)
        triangle, mix = rasterize(points, head.faces, camera.height, camera.width, depth=depth, cull="back")
        hit = triangle >= 0
        at = triangle.clamp(min=0)
        place = (corner_uv[at] * mix[..., None]).sum(-2).clamp(0, 1)
        corners = head.faces[at]
        normal = normalize((vertex_normals(vertices[n], head.faces)[corners] * mix[..., None]).sum(-2), dim=-1)
        surface = (vertices[n][corners] * mix[..., None]).sum(-2)
        cosine = (normal * normalize(camera.position - surface, dim=-1)).sum(-1)
        trust = matte_trust(matte) * _ramp(cosine, PIXEL_GRAZING, PIXEL_FACING)
        trust = trust * (1 - (lid_doubt(head, fit.parameters[n], fit.static_offset)[corners] * mix).sum(-1))
        if fit.landmarks is not None and {"eyeballs", "mouth_inner"} <= set(head.masks):
            shares = ((head.masks[name][corners] * mix).sum(-1) * hit for name in ("eyeballs", "mouth_inner"))
            trust = trust * opening_trust(fit.landmarks[n], size, *shares)
        seen = hit & (trust > 0)
        uv.append(torch.where(seen[..., None], place, torch.zeros(())))
        valid.append(seen)
        weight.append(trust * seen)
    return torch.stack(uv), torch.stack(valid), torch.stack(weight)


def matte_trust(matte: Tensor) -> Tensor:
    """Trust [H,W] in [0,1] in the pixels of a matte [H,W]: none at its edge, where colours are mixed."""
    inner = -max_pool2d(-matte[None, None], 2 * EDGE + 1, 1, EDGE)[0, 0]
    return _ramp(inner, SURE_MATTE, FULL_MATTE)


def _ramp(value: Tensor, low: float, high: float) -> Tensor:
    return ((value - low) / (high - low)).clamp(0, 1)
