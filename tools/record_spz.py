"""Write `.spz` files of made-up splats by another library, gsply (`pip install gsply zstandard`), for the tests."""

from __future__ import annotations

from pathlib import Path

import gsply
import numpy as np

from tests.drjit_splat.test_spz import made_up

FOLDER = Path(__file__).resolve().parent.parent / "tests" / "drjit_splat" / "recorded"


def main() -> None:
    splats = made_up()
    flip = np.array([1.0, -1.0, -1.0], dtype=np.float32)  # gsply leaves the axes as they are
    data = gsply.GSData(
        means=splats.means.numpy() * flip,
        scales=splats.scales.log().numpy(),
        quats=splats.quats.numpy() * np.array([1.0, 1.0, -1.0, -1.0], dtype=np.float32),
        opacities=splats.opacities.logit().numpy(),
        sh0=splats.harmonics[:, 0].numpy(),
        shN=splats.harmonics[:, 1:].numpy(),
    )
    for version in (3, 4):
        gsply.write_spz(FOLDER / f"gsply_{version}.spz", data, version=version)


if __name__ == "__main__":
    main()
