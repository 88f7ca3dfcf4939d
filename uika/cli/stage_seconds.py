"""The seconds of a command's stages."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from uika.reconstruction import Report


def print_seconds(report: Report) -> None:
    """One line for each stage, and their sum."""
    rows = [*report.seconds.items(), ("total", math.fsum(report.seconds.values()))]
    for name, seconds in rows:
        print(f"{name:<16} {seconds:7.1f} s")
