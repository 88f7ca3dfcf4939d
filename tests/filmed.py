"""A short video of a painted head whose movement is known."""

from pathlib import Path

import numpy as np
import torch

from uika.head import HeadModel, HeadParameters, look_at, pose_vertices
from uika.head.face_paint import paint, shade
from uika.io.video import write_video
from uika.motion.presets import expression_vector

GAP = range(10, 14)
FPS = 25.0


def act(head: HeadModel, path: Path) -> torch.Tensor:
    """Write a video of a head that turns and opens its mouth, with the frames of `GAP` empty; the turns [T]."""
    pictures, yaw = act_pictures(head, 24)
    frames = [np.full_like(picture, 255) if index in GAP else picture for index, picture in enumerate(pictures)]
    write_video(path, frames, FPS)
    return yaw


def act_pictures(head: HeadModel, count: int) -> tuple[list[np.ndarray], torch.Tensor]:
    """Pictures of a head that turns and opens its mouth, 8-bit, and the turns [T] in radians."""
    yaw = 0.35 * torch.sin(torch.arange(count) * 4.0 / 23)
    colours, camera = paint(head), look_at(0.0, 0.0, 0.9, (0.0, -0.02, 0.0), fov_y=20.0, size=320)
    pictures = []
    for index in range(count):
        actions = expression_vector(head, {"jawOpen": 0.5 * float(torch.sin(torch.tensor(index / 4.0)).clamp(min=0))})
        turn = torch.tensor([0.0, float(yaw[index]), 0.0])
        vertices = pose_vertices(head, HeadParameters.zeros(head).replace(expression=actions, rotation=turn))
        pictures.append(shade(vertices, head.faces, colours, camera)[0])
    return pictures, yaw
