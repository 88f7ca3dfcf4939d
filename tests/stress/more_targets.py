"""Readers of videos, models, exports and cameras: small good files, and how to read them."""

from __future__ import annotations

import dataclasses
import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from drjit_splat.cli import load_camera
from tests.drjit_splat.common import random_scene
from tests.vrm_animations import written
from uika.export import Splats, read_glb, read_splat, write_glb, write_splat
from uika.io.video import write_video
from uika.model import PRESETS, CheckpointError, Reconstructor, load_checkpoint, save_checkpoint
from uika.motion import MotionError
from uika.motion.vrm_animation import read_vrma
from uika.safeguards import verify
from uika.tracking.decode import VideoError, decode, frame_rate

from . import mutate

PROVENANCE = {"photos": "1", "consent": "yes"}


def _videos(folder: Path) -> list[Path]:
    noise = np.random.default_rng(0).integers(0, 256, (4, 48, 64, 3), np.uint8)
    write_video(folder / "a.mp4", torch.from_numpy(noise).float() / 255, fps=10, provenance=PROVENANCE)
    return [folder / "a.mp4"]


def _read_video(path: Path) -> None:
    for _ in decode(path, colour=True):
        pass
    frame_rate(path)


def _pictures(folder: Path) -> list[Path]:
    # Too small for a watermark, whose search would take most of the time.
    smooth = Image.fromarray(np.random.default_rng(0).integers(0, 256, (9, 10, 3), np.uint8)).resize((64, 48))
    made = [folder / name for name in ("a.png", "b.jpg", "c.webp")]
    for path in made:
        smooth.save(path)
    return made


def _splats() -> Splats:
    scene = random_scene(count=6)
    return Splats(*(scene[name] for name in ("means", "quats", "scales", "opacities", "colors")))


def _exports(folder: Path) -> list[Path]:
    write_glb(folder / "a.glb", _splats(), PROVENANCE)
    scene = json.dumps({"provenance": PROVENANCE, "fps": 25})
    (folder / "a.html").write_text(f'<html><script id="scene" type="application/json">{scene}</script></html>')
    (folder / "a.ply").write_text("ply\nformat ascii 1.0\ncomment photos: 1\nend_header\n")
    return [folder / name for name in ("a.glb", "a.html", "a.ply")]


def _glb(folder: Path) -> list[Path]:
    write_glb(folder / "a.glb", _splats(), PROVENANCE)
    return [folder / "a.glb"]


def _splat(folder: Path) -> list[Path]:
    write_splat(folder / "a.splat", _splats())
    return [folder / "a.splat"]


def _models(folder: Path) -> list[Path]:
    tiny = PRESETS["tiny"]
    config = dataclasses.replace(
        tiny,
        name="small",
        image_size=32,
        map_size=48,
        token_grid=8,
        backbone=dataclasses.replace(tiny.backbone, dim=16, heads=2),
        dim=16,
        heads=2,
        dpt_projections=(4, 6, 8, 8),
        dpt_features=8,
        mlp_width=12,
    )
    save_checkpoint(folder / "a.safetensors", Reconstructor(config), provenance=PROVENANCE)
    return [folder / "a.safetensors"]


def _cameras(folder: Path) -> list[Path]:
    K = [[40.0, 0, 16], [0, 40, 16], [0, 0, 1]]
    view = np.eye(4).tolist()
    (folder / "a.json").write_text(json.dumps([{"viewmat": view, "K": K, "width": 32, "height": 32}]))
    turned = {"position": [0, 0, -1.0], "rotation": np.eye(3).tolist(), "fx": 40.0, "fy": 40.0}
    (folder / "b.json").write_text(json.dumps(turned | {"width": 32, "height": 32}))
    return sorted(folder.glob("*.json"))


def _glb_damage(data: bytes, rng: random.Random) -> bytes:
    """Edit the JSON chunk, keeping the lengths right, or anything blindly."""
    size = int.from_bytes(data[12:16], "little")
    if not data.startswith(b"glTF") or rng.random() < 0.3:
        return mutate.text(data, rng) if data[:1] in b"<p" else mutate.blind(data, rng)
    body = mutate.text(data[20 : 20 + size], rng)
    rest = data[20 + size :]
    total = (20 + len(body) + len(rest)) % 2**32
    return data[:8] + total.to_bytes(4, "little") + len(body).to_bytes(4, "little") + data[16:20] + body + rest


TARGETS: dict[str, tuple[Callable[[Path], list[Path]], mutate.Mutator, Callable[[Path], Any], type[Exception]]] = {
    "video": (_videos, mutate.blind, _read_video, VideoError),
    "verify_picture": (_pictures, mutate.png, verify, ValueError),
    "verify_video": (_videos, mutate.blind, verify, ValueError),
    "verify_export": (_exports, _glb_damage, verify, ValueError),
    "glb": (_glb, _glb_damage, read_glb, ValueError),
    "vrma": (lambda folder: [written(folder / "a.vrma")], _glb_damage, read_vrma, MotionError),
    "splat": (_splat, mutate.blind, read_splat, ValueError),
    "model": (_models, mutate.safetensors, load_checkpoint, CheckpointError),
    "camera": (_cameras, mutate.text, load_camera, ValueError),
}
