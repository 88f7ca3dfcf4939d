"""The bundled portrait without and with the trained network, from all sides: `python -m benchmarks.before_after`."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from PIL import Image

from benchmarks.harness import RESULTS
from uika.assets import PORTRAIT
from uika.avatar.framing import neutral_camera
from uika.avatar.rendering import render
from uika.head import HeadParameters, load_head
from uika.io.files import replacing
from uika.io.video import to_bytes
from uika.reconstruction import reconstruct

YAWS = (0, 30, -30, 60, -60, 110, 180)
SIZE = 288


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("photo", type=Path, nargs="?", default=PORTRAIT)
    parser.add_argument("--model", default="tiny")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "before_after.png")
    options = parser.parse_args()
    head = load_head().without_bust
    rows = []
    for model in ("none", options.model):
        avatar = reconstruct([options.photo], head, model).avatar
        params = HeadParameters.zeros(head).replace(identity=avatar.identity)
        views = [render(avatar, params, neutral_camera(avatar, yaw=yaw, size=SIZE), head).rgb for yaw in YAWS]
        rows.append(torch.cat(views, dim=1))
    with replacing(options.output) as temporary:
        Image.fromarray(to_bytes(torch.cat(rows))).save(temporary, format="PNG")
    print(f"wrote {options.output}: above without the network, below with it; yaw {', '.join(map(str, YAWS))} degrees")


if __name__ == "__main__":
    main()
