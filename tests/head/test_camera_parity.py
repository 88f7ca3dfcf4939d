"""Against recorded cameras of the released program (not part of the repository)."""

import pytest
import torch
from safetensors.torch import load_file

from tests.recorded import PARITY, recorded
from uika.head import Camera, ellipse, project

FILE = PARITY / "camera.safetensors"
pytestmark = recorded


def test_views_and_pixels() -> None:
    data = load_file(FILE)
    to_world = data["in/transform_matrix_opengl"].double()
    to_world[:, :3, 1:3] *= -1
    torch.testing.assert_close(to_world.float(), data["out/c2w_opencv"], rtol=0, atol=1e-6)
    camera = Camera(torch.linalg.inv(to_world), data["out/intrinsics"][:, :3, :3].double(), 512, 384)
    # Recorded matrices act on row vectors; recorded pixels count from the first pixel's centre.
    torch.testing.assert_close(camera.viewmat.mT.float(), data["out/world_view"], rtol=0, atol=1e-6)
    torch.testing.assert_close(camera.position.float(), data["out/camera_center"], rtol=0, atol=1e-6)
    pixels, _ = project(data["in/points"].double().expand(4, -1, -1), camera)
    recorded = data["out/pixel_xy"].double() + 0.5
    # Relative to a pixel's distance from the corner: a float32 of 4500 pixels is no finer than 2e-4.
    assert ((pixels - recorded).norm(dim=-1) / recorded.norm(dim=-1)).max() < 1e-6


def test_released_rasterizer_from_its_matrices() -> None:
    """The recorded pixels come from float32 clip coordinates, whose divisor is a little larger than the depth."""
    data = load_file(FILE)
    points = torch.cat([data["in/points"], torch.ones(30, 1)], dim=1)
    clip = points @ data["out/full_proj"]
    pixels = ((clip[..., :2] / (clip[..., 3:] + 1e-7) + 1) * torch.tensor([512.0, 384.0]) - 1) / 2
    torch.testing.assert_close(pixels, data["out/pixel_xy"], rtol=1e-6, atol=0)
    own = data["out/intrinsics"][:, :3, :3]
    focal = torch.stack([own[:, 0, 0], own[:, 1, 1]], dim=1)
    torch.testing.assert_close(torch.tensor([512.0, 384.0]) / focal / 2, data["out/tanfov"], rtol=0, atol=1e-6)


def test_orbit() -> None:
    recorded = load_file(FILE.with_name("orbit_cameras.safetensors"))
    cameras = ellipse(int(recorded["in/num_frames"][0]))
    to_world = torch.linalg.inv(cameras.viewmat.double())
    torch.testing.assert_close(to_world.float(), recorded["out/c2w"].float(), rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="at least one camera"):
        ellipse(0)
