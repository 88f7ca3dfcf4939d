"""How well a video's motion is found again: an avatar acts a known motion, the rendered video is tracked.

Run `python -m benchmarks.tracking`; writes `benchmarks/results/tracking.{json,md,png}`: correlation of the 20 strongest
actions, head pose error, frames per second, and six tracked frames beside the head that follows them.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

# Small products on two cores: see `uika.cli`. Before numpy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from benchmarks.harness import RESULTS, markdown, save
from uika.assets import PORTRAIT
from uika.avatar import Avatar
from uika.avatar.rendering import render
from uika.head import HeadModel, load_head, look_at, rodrigues
from uika.io.video import write_video
from uika.motion import Motion
from uika.motion.presets import get_motion
from uika.reconstruction import reconstruct
from uika.tracking import Track, track_video, video_frames
from uika.tracking.preview import face_parameters, tracked_camera

FPS, SIZE = 25.0, 512
STRONGEST = 20
SHOWN = 6


def act(head: HeadModel, seconds: float) -> Motion:
    """The built-in talk and faces, one after the other, on a head that turns, nods, tilts and sways."""
    parts = [get_motion(name, head, FPS).expression for name in ("talk", "expressions")]
    count = round(FPS * seconds)
    expression = torch.cat((*parts, parts[-1][-1:].expand(count, -1)))[:count]
    time_ = torch.arange(count) / FPS

    def swing(size: float, hertz: float, phase: float = 0.0) -> Tensor:
        return size * torch.sin(2 * math.pi * hertz * time_ + phase)

    degree = math.pi / 180
    still = torch.zeros(count, 3)
    return Motion(
        expression=expression,
        rotation=still,
        neck=torch.stack((swing(10 * degree, 0.23, 0.4), swing(22 * degree, 0.17), swing(7 * degree, 0.31, 1)), -1),
        jaw=still,
        eyes=torch.zeros(count, 6),
        translation=torch.stack((swing(0.02, 0.2), swing(0.01, 0.27), swing(0.03, 0.13)), -1),
        fps=FPS,
    )


def film(avatar: Avatar, motion: Motion, head: HeadModel, path: Path) -> None:
    camera = look_at(0.0, 0.0, 1.2, (0.0, -0.02, 0.0), fov_y=20.0, size=SIZE)
    canonical, params = avatar.canonical_vertices(head), motion.parameters(avatar.identity)

    def pictures() -> Iterator[Tensor]:
        for index in range(len(motion)):
            with torch.no_grad():
                yield render(avatar, params[index], camera, head, canonical=canonical).rgb

    write_video(path, pictures(), motion.fps)


def angles(one: Tensor, other: Tensor) -> Tensor:
    """Degrees [T] between rotations given as axis-angle [T,3]."""
    turn = rodrigues(one.double()) @ rodrigues(other.double()).mT
    return torch.rad2deg(torch.acos(((turn.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2).clamp(-1, 1)))


def compare(found: Motion, true: Motion, head: HeadModel) -> dict[str, object]:
    reach = head.landmarks(head.expression_basis).square().sum(-1).mean(-1).sqrt()
    strength = true.expression.std(0) * reach
    strongest = strength.argsort(descending=True)[:STRONGEST].tolist()
    correlation = {}
    for index in strongest:
        pair = torch.stack((found.expression[:, index], true.expression[:, index]))
        correlation[head.expression_names[index]] = round(float(torch.corrcoef(pair)[0, 1].nan_to_num()), 3)
    shift = found.translation - true.translation
    return {
        "mean correlation": round(float(np.mean(list(correlation.values()))), 3),
        "pose rmse deg": round(float(angles(found.neck, true.neck).square().mean().sqrt()), 2),
        "translation rms mm": round(float((shift - shift.mean(0)).square().sum(-1).mean().sqrt()) * 1e3, 1),
        "correlation": correlation,
    }


def sheet(found: Track, video: Path, avatar: Avatar, head: HeadModel) -> Image.Image:
    """Six frames above, the avatar that follows them below."""
    canonical, tiles = avatar.canonical_vertices(head), []
    shown = np.linspace(0.08, 0.92, SHOWN) * len(found.poses)
    for index, frame in enumerate(video_frames(video)):
        if index in shown.astype(int):
            camera = tracked_camera(found, found.poses[index], SIZE // 2)
            params = face_parameters(found, index, head).replace(identity=avatar.identity)
            with torch.no_grad():
                picture = render(avatar, params, camera, head, canonical=canonical).rgb
            small = np.asarray(Image.fromarray(frame).resize((camera.width, camera.height)))
            tiles.append(np.concatenate((small, (picture.clamp(0, 1) * 255).to(torch.uint8).numpy())))
    return Image.fromarray(np.concatenate(tiles, 1))


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="of video")
    arguments = parser.parse_args(argv)
    head = load_head().without_bust
    motion = act(head, arguments.seconds)
    RESULTS.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder) / "act.mp4"
        avatar = reconstruct([PORTRAIT], head, model="none").avatar
        film(avatar, motion, head, video)
        start, processor = time.perf_counter(), time.process_time()
        found = track_video(video, head)
        wall, processor = time.perf_counter() - start, time.process_time() - processor
        sheet(found, video, avatar, head).save(RESULTS / "tracking.png")
    figures = compare(found.motion, motion, head)
    speed = {
        "frames": len(motion),
        "wall s": round(wall, 1),
        "frames per second": round(len(motion) / wall, 1),
        "processor s": round(processor, 1),
        "frames per processor second": round(len(motion) / processor, 1),
    }
    rows = [{"figure": key, "value": value} for key, value in {**figures, **speed}.items() if key != "correlation"]
    actions = [{"action": name, "correlation": value} for name, value in figures["correlation"].items()]
    seconds = {name: round(value, 1) for name, value in found.seconds.items()}
    text = f"{markdown(rows)}\n\n{markdown(actions)}\n\nSeconds by stage: "
    text += ", ".join(f"{name} {value}" for name, value in seconds.items()) + "."
    save("tracking", "Tracking a video with known motion", text, {**figures, **speed, "stages s": seconds})


if __name__ == "__main__":
    main()
