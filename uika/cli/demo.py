"""The command `uika demo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from uika.assets import PORTRAIT
from uika.cli.stage_seconds import print_seconds
from uika.io.files import check_folder, check_output


@dataclass(frozen=True)
class Demo:
    """Turn the bundled portrait into an avatar, a talking video and a contact sheet.

    Example: uika demo -o out/demo
    """

    output: Annotated[Path, arg(aliases=["-o"])] = Path("out/demo")
    """The folder for avatar.safetensors, talk.mp4 and sheet.png."""
    frame: Literal["bust", "head"] = "bust"
    """What is framed: the portrait with its shoulders, or the head alone."""
    watermark: bool = True
    """Mark video and sheet invisibly as rendered; `uika verify` finds it."""

    def run(self) -> int:
        """Do everything once, on one photo."""
        folder = check_folder(self.output)
        names = ("avatar.safetensors", "talk.mp4", "sheet.png")
        avatar_file, video, picture = (check_output(folder / name, Path(name).suffix) for name in names)
        from uika.avatar.frame_renderer import film
        from uika.avatar.rendering import check_renderer
        from uika.cli.contact_sheet import reconstruction_sheet
        from uika.head import load_head
        from uika.io.video import write_png, write_video
        from uika.motion.presets import get_motion
        from uika.reconstruction import reconstruct
        from uika.safeguards import mark, picture_provenance, stamped

        check_renderer()
        head = load_head()
        result = reconstruct([PORTRAIT], head)
        avatar = stamped(result.avatar, consent=False)
        avatar.save(avatar_file)
        known = picture_provenance(avatar, watermark=self.watermark)
        with result.report.stage("sheet"):
            sheet = reconstruction_sheet(result, head, frame=self.frame)
            write_png(picture, mark(sheet) if self.watermark else sheet, known)
        with result.report.stage("video"):
            motion = get_motion("talk", head)
            pictures = film(avatar, motion, head=head, frame=self.frame, progress=True)
            write_video(video, map(mark, pictures) if self.watermark else pictures, motion.fps, known)
        print_seconds(result.report)
        for path in (avatar_file, picture, video):
            print(f"wrote {path}")
        return 0
