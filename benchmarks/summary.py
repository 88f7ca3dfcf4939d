"""The README's few figures, from the other results: `python -m benchmarks.summary` writes `results/summary.md`."""

from __future__ import annotations

import json
from typing import Any

from benchmarks.harness import RESULTS, markdown


def table() -> str:
    """One row for each figure that matters, with the command that measures it."""
    quality, speed, film, exact = (_read(name) for name in (
        "head_quality", "rasterizer_table", "animation", "rasterizer_accuracy"))  # fmt: skip
    portrait, mesh = quality["portrait"], quality["mesh"]
    unseen = {row["photos"]: row["novel_psnr"] for row in quality["photos"]}
    avatar = next(row for row in speed["scenes"] if row["scene"] == "avatar")
    frames = next(row for row in film["speed"] if row["size"] == 512)
    errors = {row["error"]: row["median"] for row in exact["small"]}
    first, both = avatar["forward"].split(" / ")[0], avatar["forward + backward"].split(" / ")[0]
    rows = [
        ("bundled portrait at its own camera, inside the face", f"{portrait['face_psnr']:.1f} dB", "head_quality"),
        ("known head from 1 / 4 photos, at unseen views", f"{unseen[1]:.1f} / {unseen[4]:.1f} dB", "head_quality"),
        (
            "splats against Mitsuba's mesh, worst pose: mask IoU / median depth error",
            f"{min(row['mask_iou'] for row in mesh):.2f} / {max(row['depth_median_mm'] for row in mesh):.1f} mm",
            "head_quality",
        ),
        (
            f"{avatar['splats']:,} Gaussians at {avatar['side']}²: forward / forward + backward",
            f"{first} / {both} ms",
            "rasterizer_table",
        ),
        ("the same, over vectorised torch", f"{avatar['ratio']} / {avatar['ratio f + b']}", "rasterizer_table"),
        (
            "image / gradient of `means` against float64, median of random scenes",
            f"{errors['image']} / {errors['means']}",
            "rasterizer_accuracy",
        ),
        ("talking avatar at 512², posing included", f"{frames['frames/s']} frames/s", "animation"),
    ]
    named = [{"what": what, "value": value, "command": f"`python -m benchmarks.{name}`"} for what, value, name in rows]
    machine = speed["machine"]
    return f"{markdown(named)}\n\nTimes: {machine['cores']} cores of an {machine['processor']}, no graphics card."


def _read(name: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((RESULTS / f"{name}.json").read_text())
    return content


def main() -> None:
    (RESULTS / "summary.md").write_text(f"# The figures that matter\n\n{table()}\n")


if __name__ == "__main__":
    main()
