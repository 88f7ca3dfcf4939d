"""The command `uika reconstruct`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from uika.cli.stage_seconds import print_seconds
from uika.errors import UikaError
from uika.io.files import check_output


@dataclass(frozen=True)
class Reconstruct:
    """Make an avatar from photos of one person.

    Example: uika reconstruct front.jpg side.jpg -o me.safetensors
    """

    photos: Positional[tuple[Path, ...]]
    """1 to 64 photos that show the face."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path("avatar.safetensors")
    """The avatar file to write."""
    model: str = "tiny"
    """tiny, none, or a trained or released model file."""
    estimator: Path | None = None
    """A correspondence estimator in the place of the fitted head or the model's own."""
    backbone: Path | None = None
    """DINOv3 weights for released weights without their own."""
    correspondence: Literal["fit", "network", "both"] | None = None
    """What tells pixels their place: the fitted head, an estimator, or a fit that an estimator helps."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """bfloat16 runs released weights quicker where the processor has it, nearly the same."""
    refine: bool = True
    """Refine face shape and poses with the colours that two or more photos share."""
    keep: Literal["all", "foreground"] = "all"
    """foreground leaves out patches without head: quicker from several photos, nearly the same."""
    photo_splats: bool = True
    """Add splats for what the photos show outside the fitted surface: strands, collars, hats."""
    consent: bool = False
    """State in the avatar's provenance that the person shown agrees."""

    def run(self) -> int:
        """Reconstruct and save."""
        target = check_output(self.output, ".safetensors")
        _check_photos(self.photos)
        from uika.reconstruction import check_model, reconstruct
        from uika.safeguards import stamped

        check_model(self.model, self.estimator, self.backbone, self.correspondence, self.precision)
        result = reconstruct(
            self.photos,
            model=self.model,
            estimator=self.estimator,
            backbone=self.backbone,
            correspondence=self.correspondence,
            precision=self.precision,
            refine=self.refine,
            keep=self.keep,
            photo_splats=self.photo_splats,
        )
        stamped(result.avatar, consent=self.consent).save(target)
        print_seconds(result.report)
        if result.fit is not None and result.fit.gain:
            print(f"refined: {result.fit.gain}")
        if result.report.agreement:
            print("faces agree by", *(f"{value:.2f}" for value in result.report.agreement))
        print(f"wrote {target}: {len(result.avatar):,} Gaussians from {_photos(len(self.photos))}")
        return 0


def _check_photos(photos: tuple[Path, ...]) -> None:
    if not photos:
        raise UikaError("give at least one photo, for example: uika reconstruct me.jpg")
    for path in photos:
        if path.is_dir():
            raise UikaError(f"{path}: is a directory; give the photos in it one by one")
        if not path.is_file():
            raise UikaError(f"{path}: no such photo")


def _photos(count: int) -> str:
    return "1 photo" if count == 1 else f"{count} photos"
