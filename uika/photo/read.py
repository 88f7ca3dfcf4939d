"""Read a photo file to upright 8-bit sRGB pixels, refusing bad files before they cost memory."""

from __future__ import annotations

import hashlib
import io
import re
import threading
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uika.photo.error import PhotoError
from uika.photo.lens import focal_length

MAX_PIXELS = 64_000_000
MAX_BYTES = 512 * 1024 * 1024
MIN_SIDE = 64
FORMATS = ("JPEG", "PNG", "WEBP")
KINDS = "JPEG, PNG, WebP or HEIC"
_OTHERS = [  # how files begin that are pictures, or should be, but of no kind that is read
    (re.compile(start, re.IGNORECASE), name)
    for start, name in (
        (rb"GIF8", "a GIF, which has few colours"),
        (rb"II\*\0|MM\0\*", "a TIFF or a camera's raw file"),
        (rb"BM.{4}\0{4}", "a BMP file"),
        (rb".{4}ftypavi[fs]", "an AVIF file"),
        (rb"\xff\x0a|\0\0\0\x0cJXL ", "a JPEG XL file"),
        (rb"%PDF", "a PDF"),
        (rb"\s*(<\?xml[^>]*>\s*)?<svg", "a drawing (SVG)"),
        (rb"\s*<(!doctype|html)", "a web page; download the photo itself"),
        (rb"version https://git-lfs", "a Git LFS pointer; fetch the photo itself"),
        (rb".{4}ftyp", "a film; take a still of it"),
    )
]
_NO_HEIC = (b"avi", b"iso", b"mp4", b"qt", b"M4", b"avc", b"3g")  # brands of AVIF and of films
_FILTERS = threading.Lock()  # the filters of warnings are the whole process's


class _NoHeifError(Exception):
    """A HEIC file, and no package that reads it."""


@dataclass(frozen=True)
class Picture:
    """Pixels of a photo file, turned upright.

    rgb [H,W,3] uint8 sRGB, not multiplied by alpha; alpha [H,W] uint8, or None when the file is opaque;
    path as given; sha256 of the file's bytes; focal length in pixels if the camera noted it.
    """

    path: str
    sha256: str
    rgb: NDArray[np.uint8]
    alpha: NDArray[np.uint8] | None
    focal: float | None = None


def read(path: str | Path) -> Picture:
    """Read a JPEG, PNG, WebP or HEIC file with its EXIF rotation and its colour profile applied.

    Grey, palette, CMYK and 16-bit files become 8-bit RGB. The pixel count is checked from the header, before
    anything is decoded. Raises `PhotoError` for a file that is missing, empty, cut short, too large, too small
    or no photo.
    """
    data = _read_bytes(Path(path))
    with _FILTERS, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow warns of bombs, odd palettes and odd EXIF: judged below or harmless
        rgb, alpha, focal = _decode(path, data)
    return Picture(str(path), hashlib.sha256(data).hexdigest(), rgb, alpha, focal)


def _read_bytes(path: Path) -> bytes:
    if path.parts[:1] in (("http:",), ("https:",)):
        raise PhotoError(path, "is a web address; download the photo and give the file")
    try:
        if path.is_dir():
            raise PhotoError(path, f"is a directory; give a {KINDS} file")
        if not path.exists():
            raise PhotoError(path, "does not exist; check the path")
        if not path.is_file():
            raise PhotoError(path, f"is not a regular file; give a {KINDS} file")
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise PhotoError(path, f"takes {size >> 20} MiB, more than {MAX_BYTES >> 20} MiB; save a smaller copy")
        data = path.read_bytes()
    except OSError as error:
        raise PhotoError(path, f"cannot be read ({error.strerror}); check its name and permissions") from error
    if not data:
        raise PhotoError(path, "is empty; copy or download the photo again")
    return data


def _decode(path: str | Path, data: bytes) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None, float | None]:
    from PIL import Image, ImageOps, UnidentifiedImageError

    try:
        with _open(data) as image:
            _check_size(path, *image.size)
            image.load()
            focal = focal_length(image)
            ImageOps.exif_transpose(image, in_place=True)  # a copy of 64 megapixels takes 256 MiB
            return *_to_arrays(image), focal
    except PhotoError:
        raise
    except Image.DecompressionBombError as error:
        raise PhotoError(path, f"has more than {MAX_PIXELS // 10**6} megapixels; save a smaller copy") from error
    except _NoHeifError as error:
        raise PhotoError(path, "looks like HEIC; install pillow-heif (pip install 'uika-drjit[photo]')") from error
    except UnidentifiedImageError as error:
        kind = next((name for start, name in _OTHERS if start.match(data)), "not a readable photo")
        remedy = "" if ";" in kind else f"; save it as {KINDS}"
        raise PhotoError(path, f"is {kind}{remedy}") from error
    except Exception as error:  # decoders meet hostile bytes with many exception types
        raise PhotoError(path, f"is damaged or cut short ({error}); copy or export it again") from error


def _check_size(path: str | Path, width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        limit = MAX_PIXELS // 10**6
        raise PhotoError(path, f"is {width}x{height} px, more than {limit} megapixels; save a smaller copy")
    if min(width, height) < MIN_SIDE:
        raise PhotoError(path, f"is only {width}x{height} px; use a photo of at least {MIN_SIDE} px on each side")


def _open(data: bytes) -> Any:
    """An opened Pillow image; HEIC is read without making it known to the Pillow of the caller's program."""
    from PIL import Image, UnidentifiedImageError

    try:
        return Image.open(io.BytesIO(data), formats=FORMATS)
    except UnidentifiedImageError:
        if data[4:8] != b"ftyp" or data[8:12].startswith(_NO_HEIC):
            raise
    try:
        from pillow_heif import HeifImageFile
    except ImportError as error:
        raise _NoHeifError from error
    return HeifImageFile(io.BytesIO(data))


def _to_arrays(image: Any) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Pillow image of any mode to rgb [H,W,3] and alpha [H,W] or None."""
    from PIL import Image

    profile = image.info.get("icc_profile")
    if image.mode.startswith("I"):  # 16-bit grey; Pillow brings 16-bit colour to 8 bits itself
        image = Image.fromarray(np.clip(np.asarray(image) / 257.0 + 0.5, 0, 255).astype(np.uint8))
    alpha = None
    if image.has_transparency_data:
        image = image.convert("RGBA")
        alpha = np.asarray(image.getchannel("A"))
        image = image.convert("RGB")
        if alpha.min() == 255:
            alpha = None
    if image.mode not in ("RGB", "L", "CMYK"):
        image = image.convert("RGB")
    return np.array(_to_srgb(image, profile)), alpha


def _to_srgb(image: Any, profile: bytes | None) -> Any:
    """Apply an embedded colour profile (phones write Display P3); an unusable one is ignored."""
    from PIL import ImageCms

    if profile:
        try:
            source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
            converted = ImageCms.profileToProfile(image, source, ImageCms.createProfile("sRGB"), outputMode="RGB")
        except (ImageCms.PyCMSError, OSError, ValueError):
            converted = None
        if converted is not None:
            return converted
    return image if image.mode == "RGB" else image.convert("RGB")
