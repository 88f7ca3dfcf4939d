"""A page on this machine that shows the splats while they are trained."""

from __future__ import annotations

from typing import Any

import torch

from .._rotations import quats_to_rotations
from ..constants import SH_C0

HOST = "127.0.0.1"
PORT = 8080


class TrainingPage:
    """A viser server with one cloud of splats."""

    def __init__(self, port: int = PORT) -> None:
        """Start the server.

        Raises:
            ModuleNotFoundError: viser is not installed.
        """
        try:
            import viser
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("--view needs viser; run: pip install viser") from error
        self._server: Any = viser.ViserServer(host=HOST, port=port, verbose=False)

    @property
    def address(self) -> str:
        """The page's address."""
        return f"http://{HOST}:{self._server.get_port()}"

    @torch.no_grad()
    def show(self, params: dict[str, torch.nn.Parameter]) -> None:
        """Replace what the page shows."""
        half = quats_to_rotations(params["quats"]) * params["scales"].exp()[:, None]
        self._server.scene.add_gaussian_splats(
            "splats",
            centers=params["means"].numpy(),
            covariances=(half @ half.mT).numpy(),
            rgbs=(0.5 + SH_C0 * params["sh0"][:, 0]).clamp(0, 1).numpy(),
            opacities=params["opacities"].sigmoid()[:, None].numpy(),
        )

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()
