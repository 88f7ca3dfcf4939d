"""Against recorded images of a 3D Gaussian splatting rasterizer with its usual constants."""

from __future__ import annotations

import pytest
import torch
from safetensors.torch import load_file

from drjit_splat import rasterization
from tests.recorded import PARITY, recorded

FILE = PARITY / "raster_derived.safetensors"
pytestmark = recorded


@pytest.mark.parametrize("camera", ["centred", "offcentre"])
def test_recorded_images(camera: str) -> None:
    data = load_file(FILE)
    color, alpha, meta = rasterization(
        data["in/means"],
        data["in/rotations"],
        data["in/scales"],
        data["in/opacities"][:, 0],
        data["in/colors"],
        torch.linalg.inv(data["in/c2w"])[None],
        data[f"in/K_{camera}"][None, :3, :3],
        width=88,
        height=72,
        semantics="inria",
        backgrounds=data["in/bg"][None],
        render_mode="RGB+D",
        packed=False,
    )
    wanted = torch.cat([data[f"out/{camera}_{kind}"] for kind in ("rgb", "depth", "alpha")])
    error = (torch.cat([color[0], alpha[0]], -1).permute(2, 0, 1) - wanted).abs()
    # A threshold may fall the other way in float32 at single pixels.
    assert float((error.amax(0) > 2e-5).double().mean()) < 2e-3
    assert float(error.max()) < 0.01
    assert float(wanted[4].mean()) > 0.05
    visible = meta["visible"][0]  # the recording also gives radii to splats too faint for any pixel
    assert int(visible.sum()) > 200
    assert torch.equal(meta["radii"][0, visible, 0].long(), data[f"out/{camera}_radii"][visible])
