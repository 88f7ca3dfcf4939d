"""Light told apart from skin: every photo's exposure, white balance and low-order light on the head's normals.

Photos of one person differ mostly by light. Their colours in the atlas are one reflectance times a light for each
photo, which two closed-form steps find in turn: the reflectance as a mean of all photos, each light by least squares.
One photo alone tells them apart only if skin is supposed to be alike all over the face.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from uika.canonical.regions import at_texels
from uika.head import HeadModel, HeadParameters, shaped_vertices, uv_texels, vertex_normals
from uika.head.light import COUNT, harmonics, to_linear, to_srgb
from uika.uv import accumulate

SIZE = 96  # side of the atlas in which light is estimated
_ROUNDS = 12
_RIDGE = (1e-3, *(0.15,) * 3, *(2.0,) * 5)  # pull of the coefficients to no difference, over the weight of all texels
_OUTLIER = 0.2  # difference of log colours from which a texel loses influence: shadows, gloss, glasses
_LEAST = 60.0  # texels of the face that two photos must share
_DARK = 0.004  # linear level below which a colour says nothing


class LightSample(NamedTuple):
    """What N photos show of the face in a coarse atlas of M texels."""

    color: Tensor  # [N,M,3] linear
    weight: Tensor  # [N,M] pixels
    basis: Tensor  # [M,9] harmonics of the canonical normals
    normals: Tensor  # [SIZE,SIZE,3] canonical normals, 0 outside the head


@torch.no_grad()
def sample_light(
    head: HeadModel, identity: Tensor, static_offset: Tensor, images: Tensor, uv: Tensor, weight: Tensor
) -> LightSample:
    """Colours of the face in every photo.

    Args:
        head: the head model.
        identity: [K].
        static_offset: [V,3] metres.
        images: [N,3,H,W] sRGB.
        uv: [N,2,H,W] with v down, NaN where a pixel shows no part of the head.
        weight: [N,1,H,W] trust in [0,1].
    """
    binding = uv_texels(head, SIZE)
    vertices = shaped_vertices(head, HeadParameters.zeros(head).replace(identity=identity), static_offset)
    normal = torch.nn.functional.normalize(
        at_texels(head, binding, vertex_normals(vertices, head.faces)), dim=-1, eps=1e-20
    )
    sums = accumulate(to_linear(images)[None], uv[None], torch.ones_like(weight)[None], SIZE, weights=weight[None])
    total = sums.weight[0].flatten(2)[:, 0, binding.texel].float()
    color = sums.color[0].flatten(2)[:, :, binding.texel].mT.float() / total.clamp_min(1e-9)[..., None]
    if "face" in head.masks:
        hidden = torch.zeros_like(head.masks["face"])
        for name in ("eyeballs", "mouth_inner"):
            hidden = hidden + head.masks.get(name, torch.zeros(()))
        skin = at_texels(head, binding, (head.masks["face"] * (1 - hidden).clamp(0, 1))[:, None])[:, 0] > 0.5
        total = total * skin
    total = total * (color.amin(-1) > _DARK)
    return LightSample(color, total.clamp_max(4.0), harmonics(normal), binding.to_map(normal).permute(1, 2, 0))


def remembered(sample: LightSample, lights: Tensor) -> LightSample:
    """One view that stands for all photos of a sample, under the reference's light."""
    bare = sample.color.clamp_min(_DARK).log() - sample.basis @ lights
    weight = sample.weight.sum(0)
    return sample._replace(color=_mean(bare, sample.weight).exp()[None], weight=weight[None])


def joined(first: LightSample, second: LightSample) -> LightSample:
    """The views of two samples of one head."""
    color, weight = torch.cat((first.color, second.color)), torch.cat((first.weight, second.weight))
    return first._replace(color=color, weight=weight)


@torch.no_grad()
def relative_lights(sample: LightSample, reference: int, share: Tensor | None = None) -> Tensor:
    """Each photo's light over a common one, [N,9,3]: log factors of linear colours, by `harmonics` of the normal.

    Args:
        sample: of N photos.
        reference: the photo from which the others are told apart.
        share: [N] of each photo in the common light, which is their mean; None takes the reference's.

    Returns:
        0 for a single photo; the reference's for a photo that shares too little with the others.
    """
    log = sample.color.clamp_min(_DARK).log()
    count = len(log)
    shared = (sample.weight > 0).sum(0) >= 2
    weight = sample.weight * shared
    lights = torch.zeros(count, COUNT, 3)
    others = [n for n in range(count) if n != reference and float(weight[n].clamp_max(1).sum()) > _LEAST]
    robust = torch.ones_like(weight)
    for _ in range(_ROUNDS):
        bare = log - sample.basis @ lights
        mean = _mean(bare, weight * robust)
        robust = (_OUTLIER / (bare - mean).abs().mean(-1).clamp_min(_OUTLIER)) ** 2
        for n in others:
            own = weight[n] * robust[n]
            # The photo's own share in the mean would hold its light back.
            rest = torch.ones(count, 1)
            rest[n] = 0.0
            target = _mean(bare, weight * robust * rest)
            own = own * ((weight * rest).sum(0) > 0)
            lights[n] = _solve(sample.basis, log[n] - target, own)
    return lights if share is None else lights - torch.einsum("n,nkc->kc", share / share.sum(), lights)


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight[..., None]).sum(0) / weight.sum(0).clamp_min(1e-9)[:, None]


def _solve(basis: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Weighted ridge regression [9,3] of target [M,3] on basis [M,9]."""
    weighted = basis * weight[:, None]
    ridge = torch.diag(torch.tensor(_RIDGE)) * weight.sum().clamp_min(1e-6) * basis[:, 0].square().mean()
    return torch.linalg.solve(weighted.mT @ basis + ridge, weighted.mT @ target)


@torch.no_grad()
def under_reference(images: Tensor, uv: Tensor, sample: LightSample, lights: Tensor, before: int = 0) -> Tensor:
    """Photos [N,3,H,W] as if taken under the reference's light; pixels off the head keep their colours.

    Args:
        images: [N,3,H,W] sRGB.
        uv: [N,2,H,W], NaN off the head.
        sample: of these photos, after those of `before` other views.
        lights: [before+N,9,3] of `relative_lights`.
        before: number of other views.
    """
    result = images.clone()
    shared = (sample.weight > 0) & ((sample.weight > 0).sum(0) >= 2)
    for n, light in enumerate(lights[before:]):
        if not bool(light.any()):
            continue
        seen = torch.isfinite(uv[n]).all(0)
        column, row = (uv[n][:, seen] * SIZE).long().clamp(0, SIZE - 1)
        factor = harmonics(sample.normals[row, column]) @ light
        # Beyond the normals that the photos share, a polynomial knows nothing.
        known = (sample.basis @ light)[shared[before + n]]
        factor = torch.maximum(torch.minimum(factor, known.amax(0)), known.amin(0))
        result[n][:, seen] = to_srgb(to_linear(images[n][:, seen]) / factor.exp().mT)
    return result


@torch.no_grad()
def absolute_light(sample: LightSample, lights: Tensor, reference: int) -> Tensor:
    """The reference's light [9,3] over its mean on the face: `harmonics(normal) @ light` multiplies reflectance.

    Supposes that skin reflects alike all over the face, and that the mean light is white.
    """
    bare = sample.color / (sample.basis @ lights).exp()
    weight = sample.weight
    color = _mean(bare, weight)
    own = weight.sum(0) * (weight[reference] >= 0)
    light = torch.zeros(COUNT, 3)
    light[0] = 1 / sample.basis[0, 0]
    if float(own.clamp_max(1).sum()) < _LEAST:
        return light
    middle = (color * own[:, None]).sum(0) / own.sum()
    shade = color / middle
    robust = torch.ones(len(own))
    for _ in range(_ROUNDS):
        light = _solve(sample.basis, shade - 1, own * robust)
        light[0] += 1 / sample.basis[0, 0]
        error = (sample.basis @ light - shade).abs().mean(-1)
        robust = (_OUTLIER / error.clamp_min(_OUTLIER)) ** 2
    return light
