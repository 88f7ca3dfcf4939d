"""The whole way from photos to an avatar."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from uika._version import __version__
from uika.avatar import Avatar
from uika.errors import UikaError
from uika.head import Binding, HeadModel, load_head
from uika.reconstruction.canonical_head import CanonicalHead
from uika.reconstruction.fitted_photos import fit_files
from uika.reconstruction.models import LoadedModel, load_model
from uika.reconstruction.report import Report

if TYPE_CHECKING:
    from uika.fitting import Fit
    from uika.model import Keep
    from uika.photo import Photo

MAX_PHOTOS = 64


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """An avatar and what it was made from; photos and fit are in the order of the files' content hashes."""

    avatar: Avatar
    photos: tuple[Photo, ...]
    fit: Fit
    report: Report


def reconstruct(
    photos: Sequence[str | Path],
    head: HeadModel | None = None,
    model: str | Path = "tiny",
    *,
    refine: bool = True,
    keep: Keep = "all",
    report: Report | None = None,
) -> Reconstruction:
    """Make an avatar from photos of one person.

    The order of the photos does not matter.

    Args:
        photos: 1 to 64 photo files, each showing the face.
        head: the head model; None loads the one that `uika.head.load_head` finds.
        model: "tiny", the built-in network; "none", which keeps the photos' colours on the fitted surface and runs no
            network; or the path of a trained model (.safetensors).
        refine: whether to refine the fit with the colours that two or more photos share.
        keep: "foreground" leaves out what shows nothing of the head, see `uika.model.Reconstructor.forward`.
        report: filled while the stages pass; None makes a new one.

    Raises:
        PhotoError: a photo cannot be read or shows no face; the message names it.
        UikaError: there are no photos or too many.
        ValueError: the model's name or file cannot be used.
    """
    if not 1 <= len(photos) <= MAX_PHOTOS:
        raise UikaError(f"give 1 to {MAX_PHOTOS} photos of one person, not {len(photos)}")
    report = Report() if report is None else report
    with report.stage("model"):
        loaded = load_model(model)
        head = load_head() if head is None else head
    observed = fit_files(photos, head, refine=refine, report=report)
    avatar = avatar_from_fit(
        loaded, head, observed.fit, observed.images, observed.mattes, observed.digests, report, keep
    )
    return Reconstruction(avatar, observed.photos, observed.fit, report)


@torch.no_grad()
def avatar_from_fit(
    loaded: LoadedModel,
    head: HeadModel,
    fit: Fit,
    images: Tensor,
    mattes: Tensor,
    digests: Sequence[str],
    report: Report,
    keep: Keep = "all",
) -> Avatar:
    """Make an avatar from photos whose head and cameras are known.

    Args:
        loaded: the model.
        head: the head model.
        fit: heads and cameras of N photos.
        images: [N,3,S,S] sRGB in [0,1] on one plain colour.
        mattes: [N,S,S] in [0,1].
        digests: what identifies the photos, for the avatar's provenance.
        report: gets times and counts.
        keep: as in `reconstruct`.
    """
    canonical = CanonicalHead(loaded, head, fit, keep)
    gaussians = canonical.add(fit, images, mattes, report)
    return assemble(loaded.name, head, fit, gaussians, canonical.binding, digests)


def assemble(
    model: str, head: HeadModel, fit: Fit, gaussians: Iterable[Tensor], binding: Binding, digests: Sequence[str]
) -> Avatar:
    """An avatar of means, quats, scales, opacities and colours, batch dimension 1, made by the model of this name."""
    means, quats, scales, opacities, colors = (part[0] for part in gaussians)
    return Avatar(
        head_id=head.id,
        identity=fit.parameters.identity[0].clone(),
        static_offset=fit.static_offset,
        means=means,
        quats=quats,
        scales=scales,
        opacities=opacities,
        colors=colors.clamp(0, 1),
        triangle=binding.triangle,
        barycentric=binding.barycentric,
        provenance={
            "program": f"uika-drjit {__version__}",
            "model": model,
            "photos": " ".join(digests),
        },
    )
