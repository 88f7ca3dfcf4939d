"""A page on this machine that shows the splats while they are trained."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from .._rotations import quats_to_rotations
from ..constants import SH_C0
from .captures import Capture

if TYPE_CHECKING:
    from .loop import Progress

HOST = "127.0.0.1"
PORT = 8080


class TrainingPage:
    """A viser server with one cloud of splats, seen first as the first photo sees it."""

    def __init__(self, capture: Capture, port: int = PORT) -> None:
        """Start the server, at the next free port where this one is taken.

        Raises:
            ModuleNotFoundError: viser is not installed.
        """
        try:
            import viser
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("--view needs viser; run: pip install viser") from error
        self._server: Any = viser.ViserServer(host=HOST, port=port, verbose=False)
        turn, position = _camera(capture)
        ups = torch.stack([-photo.viewmat[1, :3] for photo in capture.photos])
        self._server.scene.set_up_direction(tuple(ups.mean(0).tolist()))
        ahead = max(float((capture.centre - position) @ turn[2]), 1e-3)
        camera = self._server.initial_camera
        camera.position, camera.look_at = tuple(position.tolist()), tuple((position + ahead * turn[2]).tolist())
        camera.up = tuple((-turn[1]).tolist())
        photo = capture.photos[0]
        camera.fov = float(2 * torch.atan(0.5 * photo.height / photo.K[1, 1]))
        self._text: Any = self._server.gui.add_markdown("No step is done yet.")

    @property
    def address(self) -> str:
        """The page's address."""
        return f"http://{HOST}:{self._server.get_port()}"

    @torch.no_grad()
    def show(self, params: dict[str, torch.nn.Parameter], progress: Progress) -> None:
        """Replace what the page shows."""
        half = quats_to_rotations(params["quats"]) * params["scales"].exp()[:, None]
        self._server.scene.add_gaussian_splats(
            "splats",
            centers=params["means"].numpy(),
            covariances=(half @ half.mT).numpy(),
            rgbs=(0.5 + SH_C0 * params["sh0"][:, 0]).clamp(0, 1).numpy(),
            opacities=params["opacities"].sigmoid()[:, None].numpy(),
        )
        self._text.content = f"Step {progress.step:,}: {progress.splats:,} splats, {progress.psnr:.1f} dB"

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()


def _camera(capture: Capture) -> tuple[Tensor, Tensor]:
    """Rotation [3,3] from the world and position [3] of the first photo's camera."""
    viewmat = capture.photos[0].viewmat
    return viewmat[:3, :3], -viewmat[:3, :3].T @ viewmat[:3, 3]
