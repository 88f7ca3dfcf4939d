"""What the long runs measure of one random scene."""

from __future__ import annotations

from typing import Any

Row = dict[str, Any]


def ordinary_errors(seed: int) -> Row:
    raise NotImplementedError


def extreme_errors(seed: int) -> Row:
    raise NotImplementedError


def gradient_errors(seed: int) -> Row:
    raise NotImplementedError
