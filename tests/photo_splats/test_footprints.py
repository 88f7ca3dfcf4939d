"""Splats that lie along the depths of a photo."""

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from uika.head import HeadParameters, load_head, look_at
from uika.photo_splats import PhotoView
from uika.photo_splats.footprints import STEEPEST, footprints

SIZE, SPREAD = 64, 0.6


def view() -> PhotoView:
    blank = torch.zeros(SIZE, SIZE)
    camera = look_at(25.0, 10.0, 1.0, fov_y=22.0, size=SIZE)
    return PhotoView(HeadParameters.zeros(load_head()), camera, torch.zeros(3, SIZE, SIZE), blank, blank)


def covariances(photo: PhotoView, depth: Tensor, kind: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """[M,3,3] in the camera's axes, in units of a pixel's width at the splat's depth."""
    quats, scales = footprints(photo, depth, kind, row, column, SPREAD)
    turns = torch.from_numpy(Rotation.from_quat(quats.roll(-1, 1).numpy()).as_matrix()).float()
    axes = photo.camera.viewmat[:3, :3] @ turns * scales[:, None]
    unit = depth[row, column] / photo.camera.K[0, 0]
    return axes @ axes.mT / unit[:, None, None] ** 2


def test_a_slope_is_followed_and_the_photo_sees_round_splats() -> None:
    photo = view()
    unit = 1.0 / float(photo.camera.K[0, 0])
    depth = 1.0 + 2 * unit * (torch.arange(SIZE) - SIZE / 2).expand(SIZE, SIZE)
    row, column = torch.tensor([32]), torch.tensor([32])
    found = covariances(photo, depth, torch.zeros(SIZE, SIZE, dtype=torch.long), row, column) / SPREAD**2
    # Two pixels deeper for each to the right; its thickness of half a pixel makes it a little wider.
    across = torch.tensor([1.0, 0.0, 2.0])
    normal = torch.tensor([-2.0, 0.0, 1.0]) / 5**0.5
    wanted = across[:, None] * across + 0.25 * normal[:, None] * normal + torch.diag(torch.tensor([0.0, 1.0, 0.0]))
    assert (found[0] - wanted).abs().max() < 0.1
    assert torch.linalg.eigvalsh(found)[:, 0].max() < 0.3  # thin across the surface


def test_steps_between_kinds_and_crests_are_no_slopes() -> None:
    photo = view()
    depth = torch.full((SIZE, SIZE), 1.0)
    depth[:, 32:] = 1.1
    kind = (depth > 1.05).long()
    row, column = torch.tensor([30, 30]), torch.tensor([31, 32])
    apart = covariances(photo, depth, kind, row, column)
    assert apart[:, 0, 2].abs().max() < 0.02 and apart[:, 2, 2].max() < 0.5 * SPREAD**2
    joined = covariances(photo, depth + 0.02 * torch.arange(SIZE), torch.zeros_like(kind), row, column)
    assert joined[:, 2, 2].max() < 1.1 * (STEEPEST * SPREAD) ** 2
