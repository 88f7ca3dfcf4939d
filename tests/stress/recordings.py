"""Recordings of other programs and of phones: small good files of every layout that is read."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.tracking.test_phone_videos import note_matrix, record
from uika.head.actions import ARKIT_ACTIONS
from uika.motion import MotionError, read_csv, read_json
from uika.tracking.decode import VideoError, decode, frame_rate

from . import mutate

FEW = ("jawOpen", "eyeBlink_L", "mouthSmileRight")
WEIGHTS = [0.25, 0.5, 0.75]


def _layouts() -> dict[str, Any]:
    categories = [{"index": k, "score": 0.5, "categoryName": name} for k, name in enumerate(FEW)]
    pose = dict(zip(FEW, WEIGHTS, strict=True))
    return {
        "weights": {"names": list(FEW), "metadata": {"fps": 30.0},
                    "frames": [{"weights": WEIGHTS, "time": k / 30, "rotation": []} for k in range(4)]},
        "matrix": {"exportFps": 30, "facsNames": list(ARKIT_ACTIONS), "weightMat": [[0.5] * 52] * 3},
        "categories": {"fps": 30, "frames": [{"faceBlendshapes": [{"categories": categories}]}, None, categories]},
        "curves": {"fps": 30, "time": [0, 0.1, 0.3], "blendShapes": {name: WEIGHTS for name in FEW}},
        "times": {"frames": [{"timestamp_ms": t, "blendShapes": pose} for t in (0, 33, 66, 166)]},
    }  # fmt: skip


def _json(folder: Path) -> list[Path]:
    for name, content in _layouts().items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    lines = "\n".join(json.dumps({"time": k / 24, "jawOpen": 0.1 * k}) for k in range(4))
    (folder / "lines.json").write_bytes(lines.encode("utf-16"))
    return sorted(folder.glob("*.json"))


def _csv(folder: Path) -> list[Path]:
    head, rows = "Timestamp;JawOpen;EyeBlink_L;HeadYaw", "".join(f"{40 * k};0,{k};0,5;0,1\n" for k in range(4))
    (folder / "decimal.csv").write_text(f"{head}\n{rows}")
    stamps = [f"23:59:{58 + k // 4}:{k % 4 * 6:02d}.000" if k < 8 else f"00:00:00:{k % 4 * 6:02d}.0" for k in range(12)]
    table = "\r\n".join(f"{stamp},52,0.5,0.25" if k != 5 else f"{stamp},0" for k, stamp in enumerate(stamps))
    (folder / "gaps.csv").write_bytes(f"Timecode,BlendShapeCount,jawOpen,jawLeft\r\n{table}".encode("utf-8-sig"))
    (folder / "wide.csv").write_bytes("time\tJawOpen\n0\t0.5\n0.1\t\n0.3\t0.5\n".encode("utf-16"))
    return sorted(folder.glob("*.csv"))


def _videos(folder: Path) -> list[Path]:
    noise = np.random.default_rng(0).integers(0, 256, (4, 48, 64, 3), np.uint8)
    path = record(folder / "phone.mp4", noise, (0, 0.04, 0.2, 0.24))
    note_matrix(path, (0, 1, -1, 0))
    return [path]


def _read_video(path: Path) -> None:
    for _ in decode(path, colour=True):
        pass
    frame_rate(path)


TARGETS: dict[str, tuple[Any, mutate.Mutator, Callable[[Path], Any], type[Exception]]] = {
    "neighbour_json": (_json, mutate.text, read_json, MotionError),
    "neighbour_csv": (_csv, mutate.text, read_csv, MotionError),
    "phone_video": (_videos, mutate.blind, _read_video, VideoError),
}
