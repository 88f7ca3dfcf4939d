"""The command `uika render`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from uika.cli.lighting import under_light
from uika.io.files import check_output


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
    light: str | None = None
    """"studio" or a Radiance picture (.hdr) of the surroundings to be lit by; it stays fixed to the head."""
    light_from: Path | None = None
    """A photo of a face to be lit like."""
    frame: Literal["bust", "head"] = "bust"
    """What is framed: the portrait with its shoulders, or the head alone."""
    watermark: bool = True
    """Mark the picture invisibly as rendered; `uika verify` finds it."""

    def run(self) -> int:
        """Render and save."""
        target = check_output(self.output, ".png")
        from uika.avatar import Avatar
        from uika.avatar.framing import check_view, neutral_camera
        from uika.avatar.rendering import check_renderer, render
        from uika.head import HeadParameters, load_head
        from uika.io.video import write_png
        from uika.safeguards import mark, picture_provenance

        check_view(self.yaw, self.pitch, self.size)
        avatar, head = Avatar.load(self.avatar), load_head()
        avatar.check_head(head)
        avatar = under_light(avatar, head, self.light, self.light_from)
        check_renderer()
        camera = neutral_camera(avatar, self.yaw, self.pitch, self.size, self.frame)
        rgb = render(avatar, HeadParameters.zeros(head), camera, head).rgb
        marked = mark(rgb) if self.watermark else rgb
        write_png(target, marked, picture_provenance(avatar, watermark=self.watermark))
        print(f"wrote {target}: {self.size}x{self.size} pixels")
        return 0
