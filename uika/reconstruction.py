"""The whole way from photos to an avatar."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from uika._version import __version__
from uika.assets import TINY_WEIGHTS
from uika.avatar import Avatar
from uika.errors import UikaError
from uika.head import Binding, HeadModel, load_head

if TYPE_CHECKING:
    from uika.feeding import ModelInputs
    from uika.fitting import Fit
    from uika.model import Keep, Reconstructor
    from uika.photo import Photo

MAX_PHOTOS = 64
_UNTRAINED_OPACITY = 0.95


@dataclass(frozen=True)
class Report:
    """What happened on the way: seconds of each stage and counts of what was skipped or filled in."""

    seconds: dict[str, float] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a block."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


class LoadedModel(NamedTuple):
    """A network, its name for the avatar's provenance, and whether it is run or only says what the photos show."""

    network: Reconstructor
    name: str
    run: bool


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """An avatar and what it was made from; photos and fit are in the order of the files' content hashes."""

    avatar: Avatar
    photos: tuple[Photo, ...]
    fit: Fit
    report: Report


class PreparedPhoto(NamedTuple):
    """A photo and the matte [S,S] of its head and hair."""

    photo: Photo
    hair: Tensor


class FittedPhotos(NamedTuple):
    """N photos of one person and the heads and cameras fitted to them."""

    photos: tuple[Photo, ...]
    fit: Fit
    images: Tensor  # [N,3,S,S] on one plain colour
    mattes: Tensor  # [N,S,S] in [0,1]
    digests: list[str]  # of the files


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


def fit_files(
    photos: Sequence[str | Path], head: HeadModel, *, refine: bool = True, report: Report | None = None
) -> FittedPhotos:
    """Read photos of one person and fit the head to them; they come out in the order of their content hashes.

    Raises:
        PhotoError: a photo cannot be read or shows no face; the message names it.
    """
    report = Report() if report is None else report
    with report.stage("photos"):
        prepared = [prepare_file(path) for path in photos]
    return fit_prepared(prepared, head, refine=refine, report=report)


def prepare_file(path: str | Path) -> PreparedPhoto:
    """All that a photo needs before it is fitted together with others.

    Raises:
        PhotoError: it cannot be read or shows no face; the message names it.
    """
    from uika.photo import head_matte, prepare

    photo = prepare(path)
    return PreparedPhoto(photo, head_matte(photo))


def fit_prepared(
    prepared: Sequence[PreparedPhoto], head: HeadModel, *, refine: bool = True, report: Report | None = None
) -> FittedPhotos:
    """Fit the head to prepared photos of one person; they come out in the order of their content hashes."""
    from uika.fitting import fit_photos

    report = Report() if report is None else report
    ordered = sorted(prepared, key=lambda each: each.photo.sha256)
    photos = [each.photo for each in ordered]
    with report.stage("fit"):
        pictures = [photo.image for photo in photos] if refine else None
        focals = [photo.focal for photo in photos]
        fit = fit_photos(photos, head, [each.hair for each in ordered], images=pictures, focals=focals)
    images = torch.stack([photo.image for photo in photos])
    mattes = torch.stack([photo.matte for photo in photos])
    return FittedPhotos(tuple(photos), fit, images, mattes, [photo.sha256 for photo in photos])


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
    from uika.feeding import model_inputs
    from uika.fitting import pixel_uv

    with report.stage("correspondence"):
        uv, valid, weight = pixel_uv(fit, head, mattes)
        uv = torch.where(valid[..., None], uv, torch.nan).permute(0, 3, 1, 2)
    with report.stage("reconstruction"):
        identity, config = fit.parameters.identity[0], loaded.network.config
        inputs, binding = model_inputs(config, head, identity, fit.static_offset, images, mattes, uv, weight)
        means, quats, scales, opacities, colors, counts = _gaussians(loaded, inputs, keep)
    report.counts.update(counts)
    gaussians = (means, quats, scales, opacities, colors)
    return assemble(loaded.name, head, fit, gaussians, binding, digests)


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


def check_model(model: str | Path) -> None:
    """Refuse a model that `reconstruct` could not use, before other work starts.

    Raises:
        UikaError: it is neither a built-in name nor an existing file.
    """
    if str(model) not in ("tiny", "none") and not Path(model).is_file():
        raise UikaError(f"{model}: no such model; use 'tiny', 'none' or the path of a trained model (.safetensors)")


def load_model(model: str | Path) -> LoadedModel:
    """The model of a name or file that `reconstruct` takes.

    Raises:
        ValueError: the name or file cannot be used.
    """
    from uika.model import build, load_checkpoint

    check_model(model)
    if str(model) == "tiny":
        return LoadedModel(load_checkpoint(TINY_WEIGHTS), "tiny", True)
    if str(model) == "none":
        return LoadedModel(build("tiny").eval(), "none", False)
    network = load_checkpoint(model)
    return LoadedModel(network, f"{network.config.name} ({Path(model).name})", True)


def _gaussians(
    loaded: LoadedModel, inputs: ModelInputs, keep: Keep
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, dict[str, int]]:
    """Means, quats, scales, opacities, colours (batch first) and counts, from the network or from the surface alone."""
    network = loaded.network
    if loaded.run:
        result = network(*inputs, keep)
        counts = dict(result.report)
        return result.means, result.quats, result.scales, result.opacities, result.colors, counts
    seen = network.observe(*inputs)
    surface = inputs.surface
    opacities = torch.full((1, len(inputs.texel)), _UNTRAINED_OPACITY)
    colors = seen.color.flatten(2)[:, :, inputs.texel].mT.contiguous()
    return surface.points, surface.quats, surface.scales, opacities, colors, dict(seen.report)
