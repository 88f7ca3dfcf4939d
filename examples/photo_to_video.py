"""A photo becomes a head that nods, winks and smiles: `python -m examples.photo_to_video [photo]`."""

from __future__ import annotations

import sys
from pathlib import Path

import torch

import uika
from uika.assets import PORTRAIT
from uika.motion.presets import expression_vector
from uika.safeguards import mark, picture_provenance

FPS = 25.0


def choreography(head: uika.HeadModel, seconds: float) -> uika.Motion:
    """A nod, then a wink, then a smile, while the camera goes round."""
    time = torch.linspace(0, 1, round(seconds * FPS))[:, None]
    wink, smile = (torch.exp(-(((time - at) / 0.12) ** 2)) for at in (0.45, 0.8))
    actions = wink * expression_vector(head, {"eyeBlinkLeft": 1.0, "cheekSquintLeft": 0.6})
    actions = actions + smile * expression_vector(head, {"mouthSmile": 0.8, "cheekSquint": 0.4})
    nod = torch.sin(2 * torch.pi * time / 0.3) * (time < 0.3) * torch.tensor([[0.15, 0.0, 0.0]])
    rest = torch.zeros(len(time), 3)
    eyes = torch.zeros(len(time), 6)
    yaw = 25 * torch.sin(2 * torch.pi * time[:, 0])  # degrees
    return uika.Motion(actions, rest, nod, rest, eyes, rest, FPS, yaw=yaw, pitch=torch.zeros(len(time)))


def main(photo: Path, output: Path = Path("nod.mp4"), seconds: float = 3.0, size: int = 512) -> int:
    """Reconstruct, animate and write the video; the number of its frames."""
    head = uika.load_head()
    avatar = uika.reconstruct([photo], head).avatar
    motion = choreography(head, seconds)
    pictures = (mark(picture.rgb) for picture in uika.frames(avatar, motion, head=head, size=size))
    return uika.write_video(output, pictures, FPS, picture_provenance(avatar, watermark=True))


if __name__ == "__main__":
    print(f"nod.mp4: {main(Path(sys.argv[1]) if len(sys.argv) > 1 else PORTRAIT)} frames")
