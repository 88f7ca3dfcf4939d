"""The `.splat` format of web viewers: 32 bytes for each Gaussian, no header, Y down."""

from __future__ import annotations

from pathlib import Path

from uika.errors import UikaError
from uika.export.splats import Splats
from uika.io.files import check_output


def write_splat(path: str | Path, splats: Splats) -> None:
    """Write Gaussians, the largest and most opaque first, as viewers that load step by step expect.

    Args:
        path: `.splat` file.
        splats: Gaussians in the axes that the reader assumes, usually `Splats.half_turned()`. Colours, opacities and
            rotations are rounded to 8 bits.

    Raises:
        UikaError: wrong extension, or nothing can be written there.
    """
    from drjit_splat import save_splat

    target = check_output(path, ".splat")
    target.parent.mkdir(parents=True, exist_ok=True)
    save_splat(target, splats.means, splats.quats, splats.scales, splats.opacities, splats.colors)


def read_splat(path: str | Path) -> Splats:
    """Read what `write_splat` or another program wrote, in the file's order and axes.

    Raises:
        UikaError: no such file, cut short, or with values that are not finite.
    """
    from drjit_splat import load_splat

    source = Path(path)
    if not source.is_file():
        raise UikaError(f"{source}: no such .splat file")
    try:
        found = load_splat(source)
    except ValueError as error:
        raise UikaError(str(error)) from None
    return Splats(found.means, found.quats, found.scales, found.opacities, found.colors)
