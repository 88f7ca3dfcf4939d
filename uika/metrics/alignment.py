"""Faces turned, scaled and moved to where a network was trained to see them."""

from __future__ import annotations

import torch
from torch import Tensor


def aligned(image: Tensor, points: Tensor, places: Tensor, side: int) -> Tensor:
    """The square [side,side,3] of a picture in which a face's points lie at given places.

    Args:
        image: [H,W,3]; it is black beyond its edges.
        points: [K,2] pixels of the picture.
        places: [K,2] where they should lie, in pixels of the square.
        side: of the square, pixels.
    """
    points, places = points.double(), places.double()
    # Least squares for the similarity from the square to the picture: p = a q + b q' + t, q' = q turned.
    turned = torch.stack((-places[:, 1], places[:, 0]), -1)
    system = torch.zeros(len(places), 2, 4, dtype=torch.float64)
    system[..., 0], system[..., 1] = places, turned
    system[:, 0, 2] = system[:, 1, 3] = 1
    a, b, x, y = torch.linalg.lstsq(system.reshape(-1, 4), points.reshape(-1, 1)).solution[:, 0]
    centres = torch.arange(side, dtype=torch.float64) + 0.5
    row, column = torch.meshgrid(centres, centres, indexing="ij")
    place = torch.stack((a * column - b * row + x, b * column + a * row + y), -1)
    size = torch.tensor([image.shape[1], image.shape[0]], dtype=torch.float64)
    grid = (2 * place / size - 1).to(image.dtype)[None]
    return torch.nn.functional.grid_sample(image.permute(2, 0, 1)[None], grid, align_corners=False)[0].permute(1, 2, 0)
