"""An avatar that grows photo by photo: what was computed for earlier photos is kept."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from uika.avatar import Avatar
from uika.errors import UikaError
from uika.head import HeadModel, load_head
from uika.reconstruction.agreement import warn_of_strangers
from uika.reconstruction.bust import with_bust
from uika.reconstruction.canonical_head import CanonicalHead
from uika.reconstruction.fitted_photos import FittedPhotos, PreparedPhoto, fit_prepared, prepare_files
from uika.reconstruction.models import Correspondence, check_loaded, load_model
from uika.reconstruction.outside import with_outside
from uika.reconstruction.photos_to_avatar import MAX_PHOTOS, assemble, with_doubts
from uika.reconstruction.report import Report

if TYPE_CHECKING:
    from uika.fitting import Fit
    from uika.model import Keep


class GrowingAvatar:
    """Photos of one person, added in any number of steps.

    The photos of the first step decide on the person's identity and hair, and each later photo is fitted to them and
    encoded alone. `refresh` fits and reconstructs all photos together, as `uika.reconstruct` does.
    """

    def __init__(
        self,
        model: str | Path = "tiny",
        head: HeadModel | None = None,
        keep: Keep = "all",
        *,
        estimator: str | Path | None = None,
        backbone: str | Path | None = None,
        correspondence: Correspondence | None = None,
        photo_splats: bool = True,
    ) -> None:
        """Arguments as in `uika.reconstruct`.

        Raises:
            ValueError: the model's name or file cannot be used.
        """
        self._loaded = load_model(model, estimator, backbone, correspondence)
        self._head = load_head() if head is None else head
        check_loaded(self._loaded, self._head, estimator)
        self._keep: Keep = keep
        self._photo_splats = photo_splats
        self._photos: list[PreparedPhoto] = []
        self._first: tuple[Fit | None, CanonicalHead] | None = None
        self._groups: list[FittedPhotos] = []  # photos that came in one step

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
        if not photos or len(self) + len(photos) > MAX_PHOTOS:
            raise UikaError(f"give 1 to {MAX_PHOTOS - len(self)} more photos of one person, not {len(photos)}")
        report = Report() if report is None else report
        with report.stage("photos"):
            new = prepare_files(photos, bust=self._loaded.takes_bust(self._head))
        return self._grown(self._groups, new, self._first, report)

    def refresh(self, report: Report | None = None) -> Avatar:
        """The avatar as if all photos had come at once.

        Raises:
            UikaError: there are no photos yet.
        """
        if not self._photos:
            raise UikaError("there are no photos yet: add some first")
        return self._grown([], self._photos, None, Report() if report is None else report)

    def _grown(
        self,
        before: Sequence[FittedPhotos],
        new: Sequence[PreparedPhoto],
        first: tuple[Fit | None, CanonicalHead] | None,
        report: Report,
    ) -> Avatar:
        alone = self._head.without_bust
        known = None if first is None else first[0]
        found = fit_prepared(new, alone, report=report, known=known, loaded=self._loaded)
        fit, canonical = first or (
            found.fit,
            CanonicalHead(self._loaded, alone, found.fit, self._keep, growing=True),
        )
        gaussians = canonical.add(found.fit, found.images, found.mattes, report)
        groups = [*before, found]
        photos = [photo for group in groups for photo in group.photos]
        digests = sorted(photo.sha256 for photo in photos)
        avatar = assemble(self._loaded, alone, canonical, gaussians, digests)
        fits, head, poses = [group.fit for group in groups if group.fit], alone, None
        if self._loaded.takes_bust(self._head):
            head = self._head
            avatar, poses = with_bust(avatar, head, fits, photos, report)
        if self._photo_splats and not self._loaded.on_template:
            avatar = with_outside(avatar, head, groups, report, poses)
        self._photos = [*self._photos, *new] if before else list(new)
        self._first, self._groups = (fit, canonical), groups
        warn_of_strangers(photos, report.agreement)
        return with_doubts(avatar, photos)
