"""How surely the watermark is found, how often it is seen where it is not, and what it costs.

Run `python -m benchmarks.watermark`; writes `benchmarks/results/watermark.{json,md,png}`.
"""

from __future__ import annotations

import argparse
import io
import tempfile
import time
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import av
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from benchmarks.figures import bars
from benchmarks.harness import markdown, save
from uika import Avatar, get_motion, load_head
from uika.assets import PORTRAIT
from uika.avatar.frame_renderer import film
from uika.metrics import psnr
from uika.reconstruction import reconstruct
from uika.safeguards import detect, mark
from uika.safeguards.watermark import THRESHOLD

Picture = NDArray[np.uint8]
RATES = {"MP4, CRF 18 (default)": "18", "MP4, CRF 28": "28"}


def jpeg(picture: Picture) -> Picture:
    memory = io.BytesIO()
    Image.fromarray(picture).save(memory, "JPEG", quality=80)
    return np.asarray(Image.open(memory).convert("RGB"))


def half(picture: Picture) -> Picture:
    height, width = picture.shape[:2]
    return np.asarray(Image.fromarray(picture).resize((width // 2, height // 2), Image.Resampling.LANCZOS))


def cropped(picture: Picture) -> Picture:
    """Without 10 % of each side's length."""
    margin = picture.shape[0] // 20
    return picture[margin:-margin, margin:-margin]


HANDLING: dict[str, Callable[[Picture], Picture]] = {
    "clean (PNG)": lambda picture: picture,
    "JPEG 80": jpeg,
    "resize 0.5x": half,
    "crop 10 %": cropped,
    "resize 0.5x, JPEG 80": lambda picture: jpeg(half(picture)),
}


def through_video(pictures: list[Picture], rate: str, folder: Path) -> tuple[list[Picture], int]:
    path = folder / "v.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt, stream.options = "yuv420p", {"crf": rate}
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)], path.stat().st_size


def scores(pictures: list[Picture]) -> list[float]:
    return [detect([torch.from_numpy(picture.copy()).float() / 255]).score for picture in pictures]


def summary(name: str, marked: list[float], plain: list[float] | None = None) -> dict[str, object]:
    row: dict[str, object] = {
        "handling": name,
        "pictures": len(marked),
        "detected": sum(score >= THRESHOLD for score in marked),
        "lowest score": round(min(marked), 1),
    }
    if plain is not None:
        row |= {
            "unmarked": len(plain),
            "false alarms": sum(score >= THRESHOLD for score in plain),
            "highest": round(max(plain), 1),
        }
    print(row, flush=True)
    return row


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("avatar", type=Path, nargs="?", help="by default one made from the bundled portrait")
    parser.add_argument("--pictures", type=int, default=24, help="for each handling")
    parser.add_argument("--unmarked", type=int, default=200, help="pictures to look for false alarms in")
    arguments = parser.parse_args(argv)
    head = load_head()
    avatar = Avatar.load(arguments.avatar) if arguments.avatar else reconstruct([PORTRAIT], head).avatar
    plain: list[Picture] = []
    for name in ("talk", "orbit", "expressions"):
        some = islice(film(avatar, get_motion(name, head), head=head), arguments.unmarked)
        plain += [picture.copy() for picture in some]
    plain = [plain[index] for index in np.linspace(0, len(plain) - 1, arguments.unmarked).round().astype(int)]
    marked = [mark(picture) for picture in plain]
    cost = [
        psnr(*(torch.from_numpy(p.astype(np.float32) / 255) for p in pair)) for pair in zip(marked, plain, strict=True)
    ]
    grey = np.full((512, 512, 3), 128, np.uint8)
    grey_cost = psnr(*(torch.from_numpy(p.astype(np.float32) / 255) for p in (mark(grey), grey)))
    milliseconds = 1e3 * min(_timed(plain[index % len(plain)]) for index in range(50))
    some = range(0, len(plain), max(1, len(plain) // arguments.pictures))
    rows = [summary("none, all unmarked", scores([marked[i] for i in some]), scores(plain))]
    for name, change in HANDLING.items():
        rows.append(summary(name, scores([change(marked[i]) for i in some]), scores([change(plain[i]) for i in some])))
    with tempfile.TemporaryDirectory() as folder:
        for name, rate in RATES.items():
            decoded, size = through_video(marked[:75], rate, Path(folder))
            _, before = through_video(plain[:75], rate, Path(folder))
            rows.append(summary(f"{name}, single frames", scores(decoded[::6])))
            together = detect([torch.from_numpy(p.copy()).float() / 255 for p in decoded[::6]]).score
            rows.append(summary(f"{name}, frames together", [together]) | {"bytes": size, "bytes unmarked": before})
    result: dict[str, Any] = {
        "threshold": THRESHOLD,
        "PSNR of rendered frames, dB": {"mean": round(float(np.mean(cost)), 2), "least": round(min(cost), 2)},
        "PSNR of a grey picture, dB": round(grey_cost, 2),
        "milliseconds for a 512x512 frame": round(milliseconds, 2),
        "rows": rows,
    }
    save("watermark", "Watermark", _text(result), result)
    bars(
        "watermark",
        {"least score of the marked": {"": {str(r["handling"]): _number(r["lowest score"]) for r in rows}}},
        f"score; found from {THRESHOLD}",
    )


def _number(value: object) -> float:
    return float(str(value))


def _timed(picture: Picture) -> float:
    start = time.perf_counter()
    mark(picture)
    return time.perf_counter() - start


def _text(result: dict[str, Any]) -> str:
    names = list(dict.fromkeys(key for row in result["rows"] for key in row))
    rows = [{name: row.get(name, "") for name in names} for row in result["rows"]]
    cost, grey = result["PSNR of rendered frames, dB"], result["PSNR of a grey picture, dB"]
    spent = result["milliseconds for a 512x512 frame"]
    about = (
        f"Found from a score of {result['threshold']}. Cost: {cost['mean']} dB PSNR on rendered frames, at least "
        f"{cost['least']} dB, and\n{grey} dB on an even grey; {spent} ms for a frame of 512 x 512."
    )
    return f"{about}\n\n{markdown(rows)}"


if __name__ == "__main__":
    main()
