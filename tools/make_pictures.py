"""Make the documentation's pictures from a demo run: `python tools/make_pictures.py [out/demo]`; needs Chromium."""

import base64
import io
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

from tests.chromium import page
from uika import Avatar, get_motion, load_head
from uika.export import write_html
from uika.viewer import Viewer

PICTURES = Path(__file__).resolve().parent.parent / "docs" / "pictures"
MOMENTS = (14, 42)  # frames of the talk: mouth open, mouth shut
SIDE = 420  # pixels


def viewer(avatar: Avatar) -> Image.Image:
    """The viewer with an open mouth."""
    place = tempfile.TemporaryDirectory()
    with place as folder, Viewer(avatar, load_head()) as shown, page(Path(folder), 1150, 760) as tab:
        tab.open(shown.url)
        tab.wait("document.querySelectorAll('[role=slider]').length >= 6")
        time.sleep(8)
        tab.run("document.querySelector('[role=slider]').focus()")
        for _ in range(45):
            tab.key("ArrowRight", 39)
        tab.run("document.querySelector('.mantine-Notification-closeButton')?.click()")
        time.sleep(8)
        return Image.open(io.BytesIO(tab.screenshot())).convert("RGB")


def exported(avatar: Avatar) -> Image.Image:
    """An exported page at two moments, beside each other."""
    head = load_head()
    with tempfile.TemporaryDirectory() as folder, page(Path(folder)) as tab:
        path = Path(folder) / "a.html"
        write_html(path, avatar, get_motion("talk", head), head)
        tab.open(path.as_uri())
        tab.wait("!!window.avatar")
        both = Image.new("RGB", (2 * SIDE, SIDE), "white")
        for place, frame in enumerate(MOMENTS):
            url = tab.run(f"avatar.show({SIDE}, {SIDE}, {{frame: {frame}, yaw: {20 - 40 * place}, pitch: 0}})")
            both.paste(Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))), (SIDE * place, 0))
        return both


def main(demo: Path) -> None:
    PICTURES.mkdir(parents=True, exist_ok=True)
    avatar = Avatar.load(demo / "avatar.safetensors")
    with Image.open(demo / "sheet.png") as sheet:
        found = {"sheet": sheet.convert("RGB"), "viewer": viewer(avatar), "page": exported(avatar)}
    for name, picture in found.items():
        picture.save(PICTURES / f"{name}.jpg", quality=88)
        print(f"wrote {PICTURES / name}.jpg")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/demo"))
