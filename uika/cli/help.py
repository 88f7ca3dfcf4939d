"""What `uika --help` shows: every command in one screen."""

from __future__ import annotations

import inspect
import textwrap
from typing import get_args

WIDTH = 80  # columns
_NAMES = 14  # columns for the names, with spaces around them


def overview(commands: object) -> str:
    """One line or two for each dataclass in the union `commands`, an example, and what all commands share."""
    lines = ["usage: uika COMMAND [OPTIONS]", "", "Photos in, an animatable 3D Gaussian head out.", ""]
    for command in get_args(commands):
        about = inspect.getdoc(command) or ""
        lines += textwrap.wrap(
            about.split("\n\n")[0],
            WIDTH,
            initial_indent=f"  {command.__name__.lower():<{_NAMES - 2}}",
            subsequent_indent=" " * _NAMES,
        )
    lines += ["", "Example: uika reconstruct front.jpg side.jpg -o me.safetensors", ""]
    lines += textwrap.wrap(
        "`uika COMMAND --help` says more. Every command takes --head FILE, to use another head model (see `uika head "
        "import`), and --debug, to show the traceback of an error.",
        WIDTH,
    )
    return "\n".join(lines)
