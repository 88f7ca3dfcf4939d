"""The command `uika animate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from uika.io.files import check_output

if TYPE_CHECKING:
    from uika.head import HeadModel
    from uika.motion import Motion


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
        from uika.cli.track import describe
        from uika.tracking import track_video

        found = track_video(video, head, progress=True)
        print(f"tracked {video}: {describe(found)}")
        return found.motion if self.fps is None else found.motion.resampled(self.fps)
