"""The commands of the command line; each dataclass is one command's arguments."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from uika.assets import PORTRAIT
from uika.checking_commands import Doctor, Weights
from uika.errors import UikaError
from uika.evaluate_command import Evaluate
from uika.export_command import Export
from uika.io.files import check_folder, check_output
from uika.motion_commands import Head, Track
from uika.synthesize_command import Synthesize
from uika.train_command import Train
from uika.verify_command import Verify
from uika.view_command import View

if TYPE_CHECKING:
    from uika.head import HeadModel
    from uika.motion import Motion
    from uika.reconstruction import Report


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
    """tiny, none, or a trained model file."""
    refine: bool = True
    """Refine face shape and poses with the colours that two or more photos share."""
    keep: Literal["all", "foreground"] = "all"
    """foreground leaves out patches without head: quicker from several photos, nearly the same."""
    consent: bool = False
    """State in the avatar's provenance that the person shown agrees."""

    def run(self) -> int:
        """Reconstruct and save."""
        target = check_output(self.output, ".safetensors")
        _check_photos(self.photos)
        from uika.reconstruction import reconstruct
        from uika.safeguards import stamped

        result = reconstruct(self.photos, model=self.model, refine=self.refine, keep=self.keep)
        stamped(result.avatar, consent=self.consent).save(target)
        _print_seconds(result.report)
        if result.fit.gain:
            print(f"refined: {result.fit.gain}")
        print(f"wrote {target}: {len(result.avatar):,} Gaussians from {_photos(len(self.photos))}")
        return 0


@dataclass(frozen=True)
class Animate:
    """Render a moving avatar as a video.

    Example: uika animate me.safetensors --motion talk -o me.mp4
    """

    avatar: Positional[Path]
    """The avatar file."""
    motion: str = "talk"
    """orbit, talk, expressions, or a motion: .npz, ARKit .csv or .json, FLAME parameters (file or folder)."""
    video: Path | None = None
    """A video to be driven by, instead of a motion."""
    motion_head: Path | None = None
    """The FLAME head that FLAME parameters belong to."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path("out.mp4")
    """The video to write."""
    size: int = 512
    """Side of the picture in pixels, even."""
    fps: float | None = None
    """Frames per second; else 25, or the motion's own."""
    watermark: bool = True
    """Mark the frames invisibly as rendered; `uika verify` finds it."""

    def run(self) -> int:
        """Render and encode."""
        target = check_output(self.output, ".mp4")
        from uika.avatar import Avatar
        from uika.avatar.frame_renderer import film
        from uika.avatar.rendering import check_renderer, check_view
        from uika.head import load_head
        from uika.io.video import check_even, write_video
        from uika.motion.presets import get_motion
        from uika.safeguards import mark, picture_provenance

        check_view(0.0, 0.0, check_even(self.size))
        avatar, head = Avatar.load(self.avatar), load_head()
        avatar.check_head(head)
        if self.video is None:
            source = None if self.motion_head is None else load_head(self.motion_head)
            motion = get_motion(self.motion, head, self.fps, source)
        check_renderer()
        if self.video is not None:
            motion = self._tracked(self.video, head)
        pictures = film(avatar, motion, head=head, size=self.size, progress=True)
        marked = map(mark, pictures) if self.watermark else pictures
        count = write_video(target, marked, motion.fps, picture_provenance(avatar, watermark=self.watermark))
        print(f"wrote {target}: {count} frames, {self.size}x{self.size} pixels, {motion.fps:g} frames per second")
        return 0

    def _tracked(self, video: Path, head: HeadModel) -> Motion:
        from uika.motion_commands import describe
        from uika.tracking import track_video

        found = track_video(video, head, progress=True)
        print(f"tracked {video}: {describe(found)}")
        return found.motion if self.fps is None else found.motion.resampled(self.fps)


@dataclass(frozen=True)
class Render:
    """Render an avatar at rest as a picture.

    Example: uika render me.safetensors -o me.png --yaw 30
    """

    avatar: Positional[Path]
    """The avatar file."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path("frame.png")
    """The picture to write."""
    yaw: float = 0.0
    """Degrees; positive shows the subject's left side."""
    pitch: float = 0.0
    """Degrees; positive looks from above."""
    size: int = 512
    """Side of the picture in pixels."""
    watermark: bool = True
    """Mark the picture invisibly as rendered; `uika verify` finds it."""

    def run(self) -> int:
        """Render and save."""
        target = check_output(self.output, ".png")
        from uika.avatar import Avatar
        from uika.avatar.rendering import check_renderer, check_view, neutral_camera, render
        from uika.head import HeadParameters, load_head
        from uika.io.video import write_png
        from uika.safeguards import mark, picture_provenance

        check_view(self.yaw, self.pitch, self.size)
        avatar, head = Avatar.load(self.avatar), load_head()
        avatar.check_head(head)
        check_renderer()
        camera = neutral_camera(avatar, self.yaw, self.pitch, self.size)
        rgb = render(avatar, HeadParameters.zeros(head), camera, head).rgb
        marked = mark(rgb) if self.watermark else rgb
        write_png(target, marked, picture_provenance(avatar, watermark=self.watermark))
        print(f"wrote {target}: {self.size}x{self.size} pixels")
        return 0


@dataclass(frozen=True)
class Demo:
    """Turn the bundled portrait into an avatar, a talking video and a contact sheet.

    Example: uika demo -o out/demo
    """

    output: Annotated[Path, arg(aliases=["-o"])] = Path("out/demo")
    """The folder for avatar.safetensors, talk.mp4 and sheet.png."""
    watermark: bool = True
    """Mark video and sheet invisibly as rendered; `uika verify` finds it."""

    def run(self) -> int:
        """Do everything once, on one photo."""
        folder = check_folder(self.output)
        names = ("avatar.safetensors", "talk.mp4", "sheet.png")
        avatar_file, video, picture = (check_output(folder / name, Path(name).suffix) for name in names)
        from uika.avatar.frame_renderer import film
        from uika.avatar.rendering import check_renderer
        from uika.head import load_head
        from uika.io.video import write_png, write_video
        from uika.motion.presets import get_motion
        from uika.reconstruction import reconstruct
        from uika.safeguards import mark, picture_provenance, stamped
        from uika.sheet import reconstruction_sheet

        check_renderer()
        head = load_head()
        result = reconstruct([PORTRAIT], head)
        avatar = stamped(result.avatar, consent=False)
        avatar.save(avatar_file)
        known = picture_provenance(avatar, watermark=self.watermark)
        with result.report.stage("sheet"):
            sheet = reconstruction_sheet(result, head)
            write_png(picture, mark(sheet) if self.watermark else sheet, known)
        with result.report.stage("video"):
            motion = get_motion("talk", head)
            pictures = film(avatar, motion, head=head, progress=True)
            write_video(video, map(mark, pictures) if self.watermark else pictures, motion.fps, known)
        _print_seconds(result.report)
        for path in (avatar_file, picture, video):
            print(f"wrote {path}")
        return 0


@dataclass(frozen=True)
class Bench:
    """Time the network at several numbers of photos, with its memory and errors.

    Example: uika bench model --views 1 4 16
    """

    what: Positional[Literal["model"]]
    """What to measure."""
    preset: Literal["tiny", "base", "paper"] = "tiny"
    """Size of the network; its weights are random."""
    views: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    """Numbers of photos."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path("out/model_latency")
    """The folder for the table and the figure; a second call goes on with the rows it keeps there."""

    def run(self) -> int:
        """Measure, which needs a checkout of the project."""
        folder = check_folder(self.output)
        os.environ["BENCHMARK_RESULTS"] = str(folder.resolve())
        try:
            from benchmarks.model_latency import main
        except ModuleNotFoundError as error:
            if error.name != "benchmarks":
                raise
            raise UikaError("bench needs the folder 'benchmarks': run it inside a checkout of the project") from error
        counts = [str(count) for count in self.views]
        return main(["--preset", self.preset, "--views", *counts, "--kept", str(folder / self.preset)])


Command = (
    Reconstruct
    | Animate
    | Track
    | Render
    | View
    | Export
    | Verify
    | Demo
    | Head
    | Train
    | Synthesize
    | Evaluate
    | Weights
    | Bench
    | Doctor
)


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


def _print_seconds(report: Report) -> None:
    rows = [*report.seconds.items(), ("total", math.fsum(report.seconds.values()))]
    for name, seconds in rows:
        print(f"{name:<16} {seconds:7.1f} s")
