"""One person's canonical head from photos; what was computed for each photo is kept, so that more can be added."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from uika.canonical.light import (
    LightSample,
    absolute_light,
    joined,
    relative_lights,
    remembered,
    sample_light,
    under_reference,
)
from uika.canonical.surface import SurfaceTexels, surface_texels
from uika.head import HeadModel
from uika.reconstruction.agreement import FaceDrawing, best_agreements, face_drawings
from uika.reconstruction.models import LoadedModel
from uika.reconstruction.report import Report

if TYPE_CHECKING:
    from uika.fitting import Fit
    from uika.model import Keep
    from uika.uv import Sums

_UNTRAINED_OPACITY = 0.95
_ASIDE, _FRONTAL = 0.7, 0.9  # cosines of a face's turn between which its light counts: on a profile it falls otherwise


class CanonicalHead:
    """The surface that one person's Gaussians start on, and the photos whose colours and features it has taken in."""

    def __init__(
        self, loaded: LoadedModel, head: HeadModel, fit: Fit | None, keep: Keep = "all", *, growing: bool = False
    ) -> None:
        """Prepare the surface.

        Args:
            loaded: the model.
            head: the head model.
            fit: says identity and hair, if the model needs them; its photos are not added.
            keep: as in `uika.reconstruct`.
            growing: whether photos come in several calls of `add`, for which the network's contexts are kept.

        Raises:
            CheckpointError: the model's weights were made for another head model.
        """
        from uika.model import Session

        head = head.without_bust
        self.identity = torch.zeros(len(head.identity_basis))
        self.static_offset = torch.zeros_like(head.template)
        config, prior = loaded.network.config, None
        if loaded.on_template:
            self.binding, points = loaded.template(head)
            upright = torch.eye(4)[:1].expand(len(points), -1)
            self._surface = SurfaceTexels(points[None], upright[None], torch.ones_like(points)[None])
        else:
            assert fit is not None  # LoadedModel.needs_fit
            self.identity, self.static_offset = fit.parameters.identity[0].clone(), fit.static_offset
            self._surface, self.binding = surface_texels(head, self.identity, self.static_offset, config.map_size)
            prior = self._prior
        self._head, self._config = head, config
        self._loaded, self._levels = loaded, list[Tensor]()
        self._session = Session(loaded.network, self.binding.texel, self._surface, keep, prior, growing=growing)
        self._growing, self._faces = growing, list[FaceDrawing]()
        self._run, self._on_template = loaded.run, loaded.on_template
        self._lit: LightSample | None = None
        self.light: Tensor | None = None  # [9,3] that the colours are kept under

    @torch.no_grad()
    def add(self, fit: Fit | None, images: Tensor, mattes: Tensor, report: Report) -> tuple[Tensor, ...]:
        """The Gaussians of all photos so far and N new ones, fitted to this identity.

        Args:
            fit: heads and cameras of the new photos, if the model needs them.
            images: [N,3,S,S] sRGB in [0,1] on one plain colour.
            mattes: [N,S,S] in [0,1].
            report: gets times and counts.

        Returns:
            Means [1,M,3], quats [1,M,4], scales [1,M,3], opacities [1,M] and colours [1,M,3].
        """
        from uika.reconstruction.model_inputs import levels, plausible

        with report.stage("correspondence"):
            uv, weight = self._located(fit, images, mattes)
            if self._growing or len(images) > 1:
                self._faces += face_drawings(self._head, images, uv[0], weight)
                report.agreement[:] = best_agreements(self._faces) if len(self._faces) > 1 else []
        if fit is not None and not self._on_template:
            with report.stage("light"):
                images = self._under_one_light(fit, images, uv[0], weight[:, None])
        with report.stage("reconstruction"):
            self._levels.append(levels(images, weight))
            weights = weight[None, :, None]
            if not self._on_template:
                weights = weights * plausible(self._head, self.binding, uv)
            views = images[None], mattes[None, :, None], uv, weights
            if self._run:
                result = self._session.add(*views)
                report.counts.update(result.report)
                return tuple(result)
            seen = self._session.observe(*views)
            report.counts.update(seen.report)
            colors = seen.color.flatten(2)[:, :, self.binding.texel].mT.contiguous()
            opacities = torch.full((1, len(self.binding)), _UNTRAINED_OPACITY)
            return self._surface.points, self._surface.quats, self._surface.scales, opacities, colors

    def _located(self, fit: Fit | None, images: Tensor, mattes: Tensor) -> tuple[Tensor, Tensor]:
        """UV maps [1,N,2,S,S], NaN where a pixel shows no part of the head, and the trust [N,S,S] in them."""
        from uika.fitting import pixel_uv
        from uika.model.precision import arithmetic
        from uika.reconstruction.estimated_pixels import consent, estimated_pixels

        if self._loaded.estimator is not None and self._loaded.correspondence == "network":
            with arithmetic(self._loaded.network.precision, images.device):
                return estimated_pixels(self._loaded.estimator, images, mattes)
        assert fit is not None  # LoadedModel.needs_fit
        uv, valid, weight = pixel_uv(fit, self._head, mattes)
        uv = torch.where(valid[..., None], uv, torch.nan).permute(0, 3, 1, 2)
        if self._loaded.sight is not None:
            weight = weight * consent(self._loaded.sight, images, uv)
        return uv[None], weight

    def _under_one_light(self, fit: Fit, images: Tensor, uv: Tensor, weight: Tensor) -> Tensor:
        """The photos as if taken under the mean light of the first call's that face the camera."""
        sample = sample_light(self._head, self.identity, self.static_offset, images, uv, weight)
        known, before = (sample, 0) if self._lit is None else (joined(self._lit, sample), 1)
        facing = (-fit.cameras.viewmat[:, 2, 2]).clamp_min(1e-3)
        share = ((facing / facing.max() - _ASIDE) / (_FRONTAL - _ASIDE)).clamp(0, 1)
        reference = 0 if before else int(facing.argmax())
        lights = relative_lights(known, reference, None if before else share)
        if self.light is None:
            self.light = absolute_light(known, lights, reference)
        self._lit = remembered(known, lights)
        return under_reference(images, uv, known, lights, before)

    def _prior(self, sums: Sums) -> Tensor:
        """Colours [3,S,S] for what no photo shows, from all photos pooled."""
        from uika.reconstruction.model_inputs import surface_prior
        from uika.uv import pool

        shown = torch.cat(self._levels)
        return surface_prior(self._config, self._head, self.binding, self.static_offset, pool(sums), shown)
