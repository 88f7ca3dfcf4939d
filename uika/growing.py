"""An avatar that grows photo by photo: what was computed for earlier photos is kept."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from uika.avatar import Avatar
from uika.errors import UikaError
from uika.head import HeadModel, load_head
from uika.reconstruction import MAX_PHOTOS, Report, assemble, load_model

if TYPE_CHECKING:
    from uika.fitting import Fit
    from uika.head import Binding
    from uika.model import Keep, Session
    from uika.photo import Photo
    from uika.uv import Sums


class GrowingAvatar:
    """Photos of one person, added in any number of steps.

    The photos of the first step decide on the person's identity and hair, and each later photo is fitted to them and
    encoded alone. `refresh` fits and reconstructs all photos together, as `uika.reconstruct` does.
    """

    def __init__(self, model: str | Path = "tiny", head: HeadModel | None = None, keep: Keep = "all") -> None:
        """Arguments as in `uika.reconstruct`.

        Raises:
            UikaError: the model is "none", which keeps nothing that could be used again.
            ValueError: the model's name or file cannot be used.
        """
        self._loaded = load_model(model)
        if not self._loaded.run:
            raise UikaError("model 'none' runs no network: use 'tiny' or the path of a trained model (.safetensors)")
        self._head = load_head() if head is None else head
        self._keep: Keep = keep
        self._photos: list[tuple[Photo, Tensor]] = []  # each with the matte of its head
        self._growth: _Growth | None = None

    def __len__(self) -> int:
        """The number of photos."""
        return len(self._photos)

    def add(self, photos: Sequence[str | Path], report: Report | None = None) -> Avatar:
        """The avatar from all photos so far and these; nothing is added when one of them cannot be used.

        Args:
            photos: photo files, each showing the face.
            report: gets times and counts.

        Raises:
            PhotoError: a photo cannot be read or shows no face; the message names it.
            UikaError: there are no photos, or they become too many.
        """
        from uika.photo import head_matte, prepare

        if not photos or len(self) + len(photos) > MAX_PHOTOS:
            raise UikaError(f"give 1 to {MAX_PHOTOS - len(self)} more photos of one person, not {len(photos)}")
        report = Report() if report is None else report
        with report.stage("photos"):
            prepared = sorted((prepare(path) for path in photos), key=lambda photo: photo.sha256)
            new = [(photo, head_matte(photo)) for photo in prepared]
        growth = self._grow(new, report)
        self._photos += new
        return self._assembled(growth)

    def refresh(self, report: Report | None = None) -> Avatar:
        """The avatar as if all photos had come at once.

        Raises:
            UikaError: there are no photos yet.
        """
        if not self._photos:
            raise UikaError("there are no photos yet: add some first")
        self._photos.sort(key=lambda entry: entry[0].sha256)
        self._growth = None
        return self._assembled(self._grow(self._photos, Report() if report is None else report))

    def _grow(self, new: Sequence[tuple[Photo, Tensor]], report: Report) -> _Growth:
        from uika.fitting import fit_photos

        with report.stage("fit"):
            known = None if self._growth is None else self._growth.fit
            photos, mattes = [photo for photo, _ in new], [hair for _, hair in new]
            pictures, focals = [photo.image for photo in photos], [photo.focal for photo in photos]
            fit = fit_photos(photos, self._head, mattes, images=pictures, focals=focals, known=known)
        growth = self._growth or _Growth(self._loaded.network, self._head, fit, self._keep)
        growth.add([photo for photo, _ in new], fit, report)
        self._growth = growth
        return growth

    def _assembled(self, growth: _Growth) -> Avatar:
        digests = sorted(photo.sha256 for photo, _ in self._photos)
        return assemble(self._loaded.name, self._head, growth.fit, growth.gaussians, growth.binding, digests)


class _Growth:
    """One identity with its surface, and the photos encoded for it."""

    gaussians: tuple[Tensor, ...]

    def __init__(self, network: torch.nn.Module, head: HeadModel, fit: Fit, keep: Keep) -> None:
        from uika.canonical.surface import surface_texels
        from uika.model import Reconstructor, Session

        assert isinstance(network, Reconstructor)
        self.fit = fit
        self.binding: Binding
        self._head, self._config = head, network.config
        identity = fit.parameters.identity[0]
        surface, self.binding = surface_texels(head, identity, fit.static_offset, network.config.map_size)
        self._session: Session = Session(network, self.binding.texel, surface, keep, self._prior)
        self._levels: list[Tensor] = []

    def add(self, photos: Sequence[Photo], fit: Fit, report: Report) -> None:
        """Encode photos whose fit has this identity."""
        from uika.feeding import levels, plausible
        from uika.fitting import pixel_uv

        images, mattes = (torch.stack([getattr(photo, name) for photo in photos]) for name in ("image", "matte"))
        with report.stage("correspondence"):
            uv, valid, weight = pixel_uv(fit, self._head, mattes)
            uv = torch.where(valid[..., None], uv, torch.nan).permute(0, 3, 1, 2)[None]
        with report.stage("reconstruction"):
            self._levels.append(levels(images, weight))
            weights = weight[None, :, None] * plausible(self._head, self.binding, uv)
            result = self._session.add(images[None], mattes[None, :, None], uv, weights)
        report.counts.update(result.report)
        self.gaussians = tuple(result)

    def _prior(self, sums: Sums) -> Tensor:
        from uika.feeding import surface_prior
        from uika.uv import pool

        shown = torch.cat(self._levels)
        return surface_prior(self._config, self._head, self.binding, self.fit.static_offset, pool(sums), shown)
