"""The whole way from photos to an avatar."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from uika._version import __version__
from uika.avatar import Avatar
from uika.errors import UikaError
from uika.head import HeadModel, load_head
from uika.photo_splats import PhotoView
from uika.reconstruction.agreement import warn_of_strangers
from uika.reconstruction.bust import with_bust
from uika.reconstruction.canonical_head import CanonicalHead
from uika.reconstruction.fitted_photos import fit_files
from uika.reconstruction.models import Correspondence, LoadedModel, check_loaded, load_model
from uika.reconstruction.outside import with_outside, with_views
from uika.reconstruction.report import Report

if TYPE_CHECKING:
    from uika.fitting import Fit
    from uika.model import Keep, Precision
    from uika.photo import Photo

MAX_PHOTOS = 64


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """An avatar and what it was made from; photos and fit are in the order of the files' content hashes."""

    avatar: Avatar
    photos: tuple[Photo, ...]
    fit: Fit | None  # with the torso's turn in each photo in its parameters; None for a model that needs none
    report: Report


def reconstruct(
    photos: Sequence[str | Path],
    head: HeadModel | None = None,
    model: str | Path = "tiny",
    *,
    estimator: str | Path | None = None,
    backbone: str | Path | None = None,
    correspondence: Correspondence | None = None,
    precision: Precision = "float32",
    refine: bool = True,
    keep: Keep = "all",
    photo_splats: bool = True,
    report: Report | None = None,
) -> Reconstruction:
    """Make an avatar from photos of one person.

    The order of the photos does not matter.

    Args:
        photos: 1 to 64 photo files, each showing the face.
        head: the head model; None loads the one that `uika.head.load_head` finds.
        model: "tiny", the built-in network; "none", which keeps the photos' colours on the fitted surface and runs no
            network; or the path of a trained model (.safetensors), the authors' released one among them.
        estimator: a correspondence estimator that says what each pixel shows, in the place of the fitted head or of the
            one that released weights bring.
        backbone: DINOv3 weights for released weights without their own.
        correspondence: what says what each pixel shows: "fit", the fitted head; "network", an estimator, the built-in
            one where no other is given; "both", the fitted head, in whose fit an estimator had a say. None stands for
            "network" where `estimator` is given, else for the default.
        precision: of released weights; "bfloat16" takes a part of the time where the processor computes it, and a
            little less memory, for nearly the same avatar.
        refine: whether to refine the fit with the colours that two or more photos share.
        keep: "foreground" leaves out what shows nothing of the head, see `uika.model.Reconstructor.forward`.
        photo_splats: whether to add splats for what the photos show outside the fitted surface; a model whose Gaussians
            start on the mean head gets none.
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
        loaded = load_model(model, estimator, backbone, correspondence, precision)
        head = load_head() if head is None else head
        check_loaded(loaded, head, estimator)
    alone, bust = head.without_bust, loaded.takes_bust(head)
    observed = fit_files(photos, alone, refine=refine, report=report, loaded=loaded, bust=bust)
    given = observed.fit, observed.images, observed.mattes, observed.digests
    avatar = avatar_from_fit(loaded, alone, *given, report, keep, photo_splats=False)
    if bust and observed.fit is not None:
        avatar, poses = with_bust(avatar, head, [observed.fit], observed.photos, report)
        observed = observed._replace(fit=replace(observed.fit, parameters=poses))
    if photo_splats and not loaded.on_template:
        avatar = with_outside(avatar, head if bust else alone, [observed], report)
    warn_of_strangers(observed.photos, report.agreement)
    return Reconstruction(with_doubts(avatar, observed.photos), observed.photos, observed.fit, report)


def with_doubts(avatar: Avatar, photos: Sequence[Photo]) -> Avatar:
    """The avatar with a note in its provenance if a photo's face hardly looked like a person's."""
    doubtful = [photo.sha256 for photo in photos if not photo.person]
    if not doubtful:
        return avatar
    note = f"hardly looks like a person's in {' '.join(doubtful)}"
    return replace(avatar, provenance={**avatar.provenance, "face": note})


@torch.no_grad()
def avatar_from_fit(
    loaded: LoadedModel,
    head: HeadModel,
    fit: Fit | None,
    images: Tensor,
    mattes: Tensor,
    digests: Sequence[str],
    report: Report,
    keep: Keep = "all",
    *,
    photo_splats: bool = True,
) -> Avatar:
    """Make an avatar from photos whose head and cameras are known.

    Args:
        loaded: the model.
        head: the head model; a bust is left out.
        fit: heads and cameras of N photos, if the model needs them.
        images: [N,3,S,S] sRGB in [0,1] on one plain colour.
        mattes: [N,S,S] in [0,1].
        digests: what identifies the photos, for the avatar's provenance.
        report: gets times and counts.
        keep: as in `reconstruct`.
        photo_splats: whether to add splats for what the photos show outside the fitted surface, where the fit has the
            mattes of head and hair.
    """
    head = head.without_bust
    canonical = CanonicalHead(loaded, head, fit, keep)
    gaussians = canonical.add(fit, images, mattes, report)
    avatar = assemble(loaded, head, canonical, gaussians, digests)
    if not photo_splats or loaded.on_template or fit is None or fit.head_mattes is None:
        return avatar
    shown = zip(images, mattes, fit.head_mattes, strict=True)
    return with_views(
        avatar, head, [PhotoView(fit.parameters[n], fit.cameras[n], *s) for n, s in enumerate(shown)], report
    )


def assemble(
    loaded: LoadedModel, head: HeadModel, canonical: CanonicalHead, gaussians: Iterable[Tensor], digests: Sequence[str]
) -> Avatar:
    """An avatar of means, quats, scales, opacities and colours, batch dimension 1, on its canonical head."""
    binding = canonical.binding
    means, quats, scales, opacities, colors = (part[0] for part in gaussians)
    return Avatar(
        head_id=head.id,
        identity=canonical.identity.clone(),
        static_offset=canonical.static_offset,
        means=means,
        quats=quats,
        scales=scales,
        opacities=opacities,
        colors=colors.clamp(0, 1),
        triangle=binding.triangle,
        barycentric=binding.barycentric,
        provenance={
            "program": f"uika-drjit {__version__}",
            "model": loaded.name,
            "photos": " ".join(digests),
        },
        skinning="released" if loaded.on_template else "surface",
        light=canonical.light,
    )
