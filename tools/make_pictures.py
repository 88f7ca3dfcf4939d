"""Make the README's pictures from a demo run: `python tools/make_pictures.py [out/demo]`."""

import sys
from pathlib import Path

from PIL import Image

PICTURES = Path(__file__).resolve().parent.parent / "docs" / "pictures"


def main(demo: Path) -> None:
    PICTURES.mkdir(parents=True, exist_ok=True)
    with Image.open(demo / "sheet.png") as sheet:
        sheet.convert("RGB").save(PICTURES / "sheet.jpg", quality=88)
    print(f"wrote {PICTURES / 'sheet.jpg'}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/demo"))
