"""Niantic's compressed `.spz` files: a sixth of a `.ply`, Y up."""

from __future__ import annotations

from pathlib import Path

from uika.export.splats import Splats
from uika.io.files import check_output

_FRACTION_BITS = 16  # 1/65 mm: the format's usual 12 would round a lash's place to a quarter of a millimetre


def write_spz(path: str | Path, splats: Splats) -> None:
    """Write Gaussians in the format's own axes: right, up, back, those of `posed_splats`.

    Args:
        path: `.spz` file.
        splats: Gaussians with Y up. Places are rounded to 1/65 mm; scales within 3.2 %, colours and opacities to 8
            bits, rotations to 10 bits a component.

    Raises:
        UikaError: wrong extension, or nothing can be written there.
    """
    from drjit_splat import save_spz
    from drjit_splat.constants import SH_C0

    target = check_output(path, ".spz")
    target.parent.mkdir(parents=True, exist_ok=True)
    flipped = splats.turned_over()  # `save_spz` takes the axes of splat `.ply` files and turns them over itself
    harmonics = ((splats.colors - 0.5) / SH_C0)[:, None]
    save_spz(
        target,
        *(flipped.means, flipped.quats, flipped.scales, flipped.opacities, harmonics),
        fraction_bits=_FRACTION_BITS,
    )
