"""Write `uika/assets/portrait.jpg`, the demo portrait, from the copy that scikit-image bundles.

The picture is NASA's portrait of the astronaut Eileen Collins (public domain, see `uika/assets/LICENSES.md`).
Run `python tools/make_portrait.py`; it needs scikit-image and pillow and no network.
"""

from pathlib import Path

from PIL import Image
from skimage import data

QUALITY = 92
MAX_BYTES = 150_000
TARGET = Path(__file__).resolve().parent.parent / "uika" / "assets" / "portrait.jpg"


def main() -> None:
    Image.fromarray(data.astronaut()).save(TARGET, quality=QUALITY, subsampling=0, optimize=True)
    size = TARGET.stat().st_size
    if size > MAX_BYTES:
        raise SystemExit(f"{TARGET.name} takes {size} bytes, more than {MAX_BYTES}: lower QUALITY")
    print(f"{TARGET.name}: {size} bytes")


if __name__ == "__main__":
    main()
