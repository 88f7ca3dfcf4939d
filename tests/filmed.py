"""A short video of a painted head whose movement is known."""

from pathlib import Path

import torch

from uika.head import HeadModel, HeadParameters, look_at, pose_vertices
from uika.head.face_paint import paint, shade
from uika.io.video import write_video
from uika.motion.presets import expression_vector

GAP = range(10, 14)
FPS = 25.0


def act(head: HeadModel, path: Path) -> torch.Tensor:
    """Write a video of a head that turns and opens its mouth, with the frames of `GAP` empty; the turns [T]."""
    count = 24
    yaw = 0.35 * torch.sin(torch.linspace(0, 4.0, count))
    colours, camera = paint(head), look_at(0.0, 0.0, 0.9, (0.0, -0.02, 0.0), fov_y=20.0, size=320)
    frames = []
    for index in range(count):
        actions = expression_vector(head, {"jawOpen": 0.5 * float(torch.sin(torch.tensor(index / 4.0)).clamp(min=0))})
        turn = torch.tensor([0.0, float(yaw[index]), 0.0])
        vertices = pose_vertices(head, HeadParameters.zeros(head).replace(expression=actions, rotation=turn))
        picture = torch.from_numpy(shade(vertices, head.faces, colours, camera)[0]).float() / 255
        frames.append(torch.ones_like(picture) if index in GAP else picture)
    write_video(path, frames, FPS)
    return yaw
