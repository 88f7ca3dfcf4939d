"""Write `.spz`, compressed `.ply` and `.sog` files of made-up splats, by and for another library, gsply, for the tests.

It needs `pip install gsply zstandard` beside the project.
"""

from __future__ import annotations

import io
from pathlib import Path
from types import SimpleNamespace

import gsply
import numpy as np
from gsply import sog_reader
from PIL import Image

from drjit_splat import SplatFile
from tests.drjit_splat.test_compressed_ply import COUNT, DEGREE
from tests.drjit_splat.test_sog import COUNT as SOG_COUNT
from tests.drjit_splat.test_sog import bundle, write
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
    record_sog()


def record_sog() -> None:
    """A bundle by our own writer of the tests, and what gsply reads from it."""
    bundled = write(FOLDER / "made_up.sog", *bundle(made_up(SOG_COUNT, 2)))
    # gsply decodes pictures with imagecodecs; pillow does the same.
    sog_reader.imagecodecs = SimpleNamespace(
        webp_decode=lambda data: np.asarray(Image.open(io.BytesIO(data)).convert("RGBA"))
    )
    found = sog_reader.sogread(str(bundled))
    names = ("means", "scales", "quats", "opacities", "sh0", "shN")
    np.savez_compressed(FOLDER / "gsply_sog.npz", **{name: getattr(found, name) for name in names})


if __name__ == "__main__":
    main()
