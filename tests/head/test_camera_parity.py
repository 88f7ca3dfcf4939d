"""Against recorded cameras of the released program (not part of the repository)."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from uika.head import Camera, project

FILE = Path(__file__).parents[3] / "shared" / "parity" / "camera.safetensors"

pytestmark = pytest.mark.skipif(not FILE.exists(), reason="skipped: no recorded outputs beside the checkout")


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
    # The recorded matrices are exact to 1e-7; the pixels were computed from them in float32.
    torch.testing.assert_close(pixels, recorded, rtol=3e-5, atol=0)
