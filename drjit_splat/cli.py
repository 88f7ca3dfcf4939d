"""The command `drjit-splat`: a picture of a splat file, or a scene trained from photos."""

from __future__ import annotations

import argparse
import json
import math
import secrets
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ._version import __version__

if TYPE_CHECKING:
    from torch import Tensor

    from .ply import SplatFile

_EXAMPLE = "Example: drjit-splat render scene.ply --camera cameras.json --index 3 -o out.png"
_CAMERA_HELP = (
    'a JSON file with one camera or a list of them, each {"viewmat": 4x4 world to camera in OpenCV axes, "K": 3x3, '
    '"width", "height"} or as in the cameras.json of 3DGS; without it the camera looks at the whole scene'
)
_FOV = 40.0  # degrees, of the camera that is chosen for a scene
_SHARE = 0.98  # of the splats in each direction that it should hold
_MAX_SIZE = 16384  # pixels


@dataclass(frozen=True)
class PinholeCamera:
    """One pinhole camera, OpenCV axes."""

    viewmat: Tensor  # [4,4] world to camera
    K: Tensor  # [3,3] pixels
    width: int
    height: int


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        argv: arguments without the program's name; None takes those of the process.

    Returns:
        The exit code: 0 done, 2 unusable input.
    """
    try:
        arguments = _parser().parse_args(argv)
        return int(arguments.run(arguments))
    except SystemExit as end:
        return int(end.code or 0)
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
        return 130
    except (ValueError, OSError, RuntimeError, ModuleNotFoundError) as error:
        print(f"drjit-splat: {' '.join(str(error).split())}", file=sys.stderr)
        return 2


def load_camera(path: str | Path, index: int = 0) -> PinholeCamera:
    """Read one camera of a JSON file.

    Args:
        path: one camera or a list of them; each has `viewmat`, `K`, `width`, `height` (OpenCV, world to camera) or
            `position`, `rotation`, `fx`, `fy`, `width`, `height` (camera to world, as 3DGS writes `cameras.json`).
        index: which one of a list.

    Raises:
        ValueError: not JSON, no such camera, or a field is missing or wrong.
        OSError: the file cannot be read.
    """
    try:
        found = json.loads(Path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not JSON ({error})") from None
    cameras = found if isinstance(found, list) else [found]
    if not 0 <= index < len(cameras):
        raise ValueError(f"{path} has {len(cameras)} cameras; there is no camera {index}")
    try:
        return _view(cameras[index])
    except (KeyError, TypeError, ValueError, IndexError, ArithmeticError, RuntimeError) as error:
        raise ValueError(f"{path}: camera {index} cannot be used ({type(error).__name__}: {error})") from None


def fitting_view(splats: SplatFile, yaw: float, pitch: float, size: int, y_up: bool = False) -> PinholeCamera:
    """A camera that sees nearly the whole scene.

    Args:
        splats: the scene.
        yaw: degrees around the vertical; 0 looks from the +Z side.
        pitch: degrees in (-90, 90); positive looks from above.
        size: side of the square picture in pixels.
        y_up: whether the scene's +Y points up; splat files mostly have +Y down.

    Raises:
        ValueError: there is no splat, or a value is out of range.
    """
    import torch

    if len(splats.means) == 0 or not abs(pitch) < 90 or not math.isfinite(yaw) or not 1 <= size <= _MAX_SIZE:
        raise ValueError(f"needs a splat, |pitch| < 90 and a size of 1 to {_MAX_SIZE}, not {yaw=}, {pitch=}, {size=}")
    centre = splats.means.median(0).values.double()
    radius = float(
        torch.quantile((splats.means - centre).norm(dim=-1).float()[:: 1 + len(splats.means) // 10**6], _SHARE)
    )
    up = 1.0 if y_up else -1.0
    a, b = math.radians(yaw), math.radians(pitch)
    # Seen along -Z, right is +X where Y is up and -X where it is down.
    backward = torch.tensor([up * math.sin(a) * math.cos(b), up * math.sin(b), math.cos(a) * math.cos(b)]).double()
    right = torch.tensor([up * math.cos(a), 0.0, -math.sin(a)]).double()
    rotation = torch.stack((right, torch.linalg.cross(-backward, right), -backward))
    position = centre + backward * max(radius, 1e-6) / math.sin(math.radians(_FOV / 2))
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
    focal = size / 2 / math.tan(math.radians(_FOV / 2))
    K = torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    return PinholeCamera(viewmat.float(), K, size, size)


def _view(camera: Any) -> PinholeCamera:
    import torch

    width, height = int(camera["width"]), int(camera["height"])
    if not (1 <= width <= _MAX_SIZE and 1 <= height <= _MAX_SIZE):
        raise ValueError(f"the picture's sides must lie between 1 and {_MAX_SIZE} pixels")
    if "viewmat" in camera:
        viewmat, K = (torch.tensor(camera[name], dtype=torch.float32) for name in ("viewmat", "K"))
    else:
        rotation = torch.tensor(camera["rotation"], dtype=torch.float64).mT
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3] = rotation
        viewmat[:3, 3] = -rotation @ torch.tensor(camera["position"], dtype=torch.float64)
        fx, fy = float(camera["fx"]), float(camera["fy"])
        K = torch.tensor([[fx, 0.0, width / 2], [0.0, fy, height / 2], [0.0, 0.0, 1.0]])
    if viewmat.shape != (4, 4) or K.shape != (3, 3):
        raise ValueError("viewmat must be 4x4 and K 3x3")
    return PinholeCamera(viewmat.float(), K, width, height)


def _render(arguments: argparse.Namespace) -> int:
    output = Path(arguments.output)
    if output.suffix.lower() != ".png":
        raise ValueError(f"{output}: the output's name must end in .png")
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("writing pictures needs pillow; run: pip install pillow") from error
    import torch

    from . import load_splats, rasterization

    splats = load_splats(arguments.scene)
    if not len(splats.means):
        raise ValueError(f"{arguments.scene} holds no splats")
    if arguments.camera:
        view = load_camera(arguments.camera, arguments.index)
    else:
        view = fitting_view(splats, arguments.yaw, arguments.pitch, arguments.size, arguments.y_up)
    start = time.perf_counter()
    image, _, meta = rasterization(
        splats.means,
        splats.quats,
        splats.scales,
        splats.opacities,
        splats.harmonics,
        view.viewmat[None],
        view.K[None],
        view.width,
        view.height,
        sh_degree=splats.degree,
        backgrounds=torch.tensor([arguments.background]),
    )
    seconds = time.perf_counter() - start
    pixels = (image[0].clamp(0, 1) * 255).round().byte().numpy()
    temporary = output.with_name(f".{output.stem}.{secrets.token_hex(4)}.png")
    output.parent.mkdir(parents=True, exist_ok=True)
    try:
        Image.fromarray(pixels).save(temporary)
        temporary.replace(output)
    finally:
        temporary.unlink(missing_ok=True)
    seen = int(meta["n_visible"][0])
    print(
        f"wrote {output}: {view.width}x{view.height} pixels, {seen:,} of {len(splats.means):,} splats, {seconds:.2f} s"
    )
    return 0


def _parser() -> argparse.ArgumentParser:
    from .training.command import add_parser as add_training

    about = f"Render and train 3D Gaussian splats with Dr.Jit. {_EXAMPLE}"
    parser = argparse.ArgumentParser("drjit-splat", description=about)
    parser.add_argument("--version", action="version", version=f"drjit-splat {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    render = commands.add_parser("render", help="render a splat file", description=_EXAMPLE)
    render.add_argument("scene", help="a .ply (plain or compressed), .spz, .sog or .splat file")
    render.add_argument("-o", "--output", default="out.png", help="the picture to write (default: %(default)s)")
    render.add_argument("--camera", help=_CAMERA_HELP)
    render.add_argument("--index", type=int, default=0, help="which camera of a list (default: %(default)s)")
    render.add_argument("--yaw", type=float, default=0.0, help="degrees, without --camera; 0 looks from the +Z side")
    render.add_argument("--pitch", type=float, default=0.0, help="degrees, without --camera; positive: from above")
    render.add_argument("--size", type=int, default=800, help="pixels, without --camera (default: %(default)s)")
    render.add_argument("--y-up", action="store_true", help="without --camera: +Y points up, not down")
    render.set_defaults(run=_render)
    colors = {"type": float, "nargs": 3, "metavar": ("R", "G", "B"), "default": [1.0, 1.0, 1.0]}
    render.add_argument("--background", help="in [0,1] (default: white)", **colors)  # type: ignore[arg-type]
    add_training(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())
