"""The command `uika animate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from uika.cli.lighting import under_light
from uika.errors import UikaError
from uika.io.files import check_output

if TYPE_CHECKING:
    from uika.head import HeadModel
    from uika.io.sound import Sound
    from uika.motion import Motion

_LONGEST = 100_000  # bytes of a transcript


@dataclass(frozen=True)
class Animate:
    """Render a moving avatar as a video.

    Example: uika animate me.safetensors --motion talk -o me.mp4
    """

    avatar: Positional[Path]
    """The avatar file."""
    motion: str = "talk"
    """orbit, talk, expressions, or a motion file."""
    video: Annotated[Path | None, arg(metavar="PATH")] = None
    """A video to be driven by instead."""
    speech: Annotated[str | None, arg(metavar="STR")] = None
    """A text to speak, or a recording."""
    transcript: Annotated[Path | None, arg(metavar="PATH")] = None
    """The recording's words in a text file."""
    language: Annotated[str | None, arg(metavar="STR")] = None
    """Of the text, such as de; else guessed."""
    motion_head: Annotated[Path | None, arg(metavar="PATH")] = None
    """The head of FLAME parameters."""
    save_motion: Annotated[Path | None, arg(metavar="PATH")] = None
    """Write the motion to a file, too."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path("out.mp4")
    """The video to write."""
    size: int = 512
    """Side of the picture in pixels, even."""
    light: Annotated[str | None, arg(metavar="STR")] = None
    """studio, or surroundings (.hdr) to be lit by."""
    light_from: Annotated[Path | None, arg(metavar="PATH")] = None
    """A photo of a face to be lit like."""
    fps: float | None = None
    """Else 25, or the motion's own."""
    frame: Literal["bust", "head"] = "bust"
    """Portrait with shoulders, or head."""
    level: Literal["auto", "full", "half"] = "auto"
    """half: half as many Gaussians; auto: in small films."""
    watermark: bool = True
    """Invisible; `uika verify` finds it."""

    def run(self) -> int:
        """Render and encode."""
        target = check_output(self.output, ".mp4")
        self._check()
        from uika.avatar import Avatar
        from uika.avatar.frame_renderer import film
        from uika.avatar.framing import check_view
        from uika.avatar.rendering import check_renderer
        from uika.head import load_head
        from uika.io.video import check_even, write_video
        from uika.motion.presets import get_motion
        from uika.motion.write import check_motion_output, write_motion
        from uika.safeguards import mark, picture_provenance

        check_view(0.0, 0.0, check_even(self.size))
        if self.save_motion is not None:
            check_motion_output(self.save_motion)
        avatar, head = Avatar.load(self.avatar), load_head()
        avatar.check_head(head)
        avatar = under_light(avatar, head, self.light, self.light_from)
        sound: Sound | None = None
        if self.speech is not None:
            motion, sound = self._spoken(self.speech, head)
        elif self.video is None:
            source = None if self.motion_head is None else load_head(self.motion_head)
            motion = get_motion(self.motion, head, self.fps, source)
        if self.video is None and self.save_motion is not None:
            write_motion(motion, self.save_motion, head)
        check_renderer()
        if self.video is not None:
            motion = self._tracked(self.video, head)
            if self.save_motion is not None:
                write_motion(motion, self.save_motion, head)
        pictures = film(avatar, motion, head=head, size=self.size, frame=self.frame, level=self.level, progress=True)
        marked = map(mark, pictures) if self.watermark else pictures
        provenance = picture_provenance(avatar, watermark=self.watermark)
        count = write_video(target, marked, motion.fps, provenance, sound)
        heard = "" if self.speech is None else ", with sound" if sound else ", silent: install espeak-ng for a voice"
        print(
            f"wrote {target}: {count} frames, {self.size}x{self.size} pixels, {motion.fps:g} frames per second{heard}"
        )
        return 0

    def _check(self) -> None:
        if self.speech is not None and self.video is not None:
            raise UikaError("--speech and --video both say how the head moves; give one of them")
        if self.speech is None and (self.transcript is not None or self.language is not None):
            raise UikaError("--transcript and --language go with --speech")

    def _spoken(self, spoken: str, head: HeadModel) -> tuple[Motion, Sound | None]:
        from uika.motion.speech import FPS, is_text, speech, voice_of

        words = None
        if is_text(spoken):
            if self.transcript is not None:
                raise UikaError("--transcript goes with a recording; --speech has a text, which is its own")
            words = spoken
        elif self.transcript is not None:
            words = _read_transcript(self.transcript)
        sound = voice_of(spoken, self.language)
        heard = spoken if sound is None else sound
        return speech(heard, words, head, self.fps or FPS, language=self.language), sound

    def _tracked(self, video: Path, head: HeadModel) -> Motion:
        from uika.cli.track import describe
        from uika.tracking import track_video

        found = track_video(video, head, progress=True)
        print(f"tracked {video}: {describe(found)}")
        return found.motion if self.fps is None else found.motion.resampled(self.fps)


def _read_transcript(path: Path) -> str:
    if not path.is_file():
        raise UikaError(f"{path}: no such text file")
    if path.stat().st_size > _LONGEST:
        raise UikaError(f"{path}: is longer than anybody speaks in ten minutes")
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise UikaError(f"{path}: is no text in UTF-8 ({error})") from error
