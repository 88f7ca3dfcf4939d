"""A contact sheet: labelled pictures in a grid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from uika.avatar.framing import Framing, neutral_camera
from uika.avatar.rendering import render
from uika.head import Camera, HeadModel, HeadParameters
from uika.io.video import to_bytes
from uika.motion.presets import EXPRESSIONS, expression_vector
from uika.reconstruction import Reconstruction

_YAWS = (-60.0, -30.0, 30.0, 60.0)  # degrees
_FACES = ("smile", "surprise", "frown", "kiss")
_LABEL = 20  # pixels under each picture


def contact_sheet(cells: Sequence[tuple[str, Tensor]], columns: int, cell: int = 256) -> Tensor:
    """Lay out pictures [h,w,3] with their labels in rows of `columns`, each scaled to `cell` x `cell` pixels.

    Returns:
        The sheet [H,W,3] in [0,1], white where nothing is.
    """
    from PIL import Image, ImageDraw

    rows = -(-len(cells) // columns)
    sheet = Image.new("RGB", (columns * cell, rows * (cell + _LABEL)), "white")
    draw = ImageDraw.Draw(sheet)
    for index, (label, picture) in enumerate(cells):
        left, top = index % columns * cell, index // columns * (cell + _LABEL)
        sheet.paste(Image.fromarray(to_bytes(_scaled(picture, cell))), (left, top))
        draw.text((left + cell // 2, top + cell + _LABEL // 2), label, fill="black", anchor="mm")
    return torch.from_numpy(np.asarray(sheet).astype(np.float32) / 255)


def reconstruction_sheet(result: Reconstruction, head: HeadModel, cell: int = 256, frame: Framing = "bust") -> Tensor:
    """The first photo, the avatar from the photo's camera, from four sides and with four expressions; [H,W,3]."""
    avatar = result.avatar
    assert result.fit is not None  # of the built-in network, which needs one
    canonical = avatar.canonical_vertices(head)
    rest = HeadParameters.zeros(head)

    def look(params: HeadParameters, camera: Camera) -> Tensor:
        return render(avatar, params, camera, head, canonical=canonical).rgb

    cells = [
        ("photo", result.photos[0].image.permute(1, 2, 0)),
        ("avatar at the photo's camera", look(result.fit.parameters[0], result.fit.cameras[0])),
    ]
    front = neutral_camera(avatar, size=2 * cell, frame=frame)
    views = {f"{yaw:+.0f} degrees": neutral_camera(avatar, yaw, size=2 * cell, frame=frame) for yaw in _YAWS}
    cells += [(label, look(rest, camera)) for label, camera in views.items()]
    for name in _FACES:
        cells.append((name, look(rest.replace(expression=expression_vector(head, EXPRESSIONS[name])), front)))
    return contact_sheet(cells, columns=5, cell=cell)


def _scaled(picture: Tensor, cell: int) -> Tensor:
    channels = picture.permute(2, 0, 1)[None]
    return functional.interpolate(channels, (cell, cell), mode="bilinear", antialias=True)[0].permute(1, 2, 0)
