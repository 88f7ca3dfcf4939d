"""Write `.spz` and compressed `.ply` files of made-up splats by another library, gsply, for the tests.

It needs `pip install gsply zstandard` beside the project.
"""

from __future__ import annotations

from pathlib import Path

import gsply
import numpy as np

from drjit_splat import SplatFile
from tests.drjit_splat.test_compressed_ply import COUNT, DEGREE
from tests.drjit_splat.test_spz import made_up

FOLDER = Path(__file__).resolve().parent.parent / "tests" / "drjit_splat" / "recorded"


def data(splats: SplatFile, mean_signs: tuple[float, ...], quat_signs: tuple[float, ...]) -> gsply.GSData:
    """The splats as gsply keeps them: logarithms, logits and harmonics."""
    return gsply.GSData(
        means=splats.means.numpy() * np.array(mean_signs, dtype=np.float32),
        scales=splats.scales.log().numpy(),
        quats=splats.quats.numpy() * np.array(quat_signs, dtype=np.float32),
        opacities=splats.opacities.logit().numpy(),
        sh0=splats.harmonics[:, 0].numpy(),
        shN=splats.harmonics[:, 1:].numpy(),
    )


def main() -> None:
    flipped = data(made_up(), (1, -1, -1), (1, 1, -1, -1))  # gsply leaves the axes as they are
    for version in (3, 4):
        gsply.write_spz(FOLDER / f"gsply_{version}.spz", flipped, version=version)
    gsply.plywrite(
        str(FOLDER / "gsply.compressed.ply"), data(made_up(COUNT, DEGREE), (1, 1, 1), (1, 1, 1, 1)), compressed=True
    )


if __name__ == "__main__":
    main()
