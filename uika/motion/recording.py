"""What files of named activations have in common: a table whose columns are understood, checked and completed."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uika.errors import UikaWarning
from uika.head.actions import ARKIT_ACTIONS
from uika.io.text import read_text
from uika.motion.action_names import HEAD_ANGLES, find_actions
from uika.motion.frame_times import even_places, in_seconds, is_even, rate_of, resampled
from uika.motion.motion import Motion, MotionError

FPS = 60.0  # of phones, where the file does not say
MOST = 1.5  # capture programs exaggerate up to this; whoever writes percent goes far beyond
_LEAST = -0.5
_TOLERANCE = 1e-3
_SIZES = {"rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3}


@dataclass(frozen=True)
class Recording:
    """T rows of named numbers as a file gives them.

    rows: name -> number; a name that is missing or None says nothing, and None for a row means that no face was seen.
    labels: what a message calls each row. times: of the rows, in any unit, if the file has them. fps: if it says.
    """

    rows: list[dict[str, Any] | None]
    labels: list[str]
    times: list[float] | None = None
    fps: float | None = None


def from_file(path: Path, kind: str, parse: Callable[[str], Recording]) -> Motion:
    """The motion in a text file; errors and warnings name the file.

    Args:
        path: the file.
        kind: what it should be, for the message.
        parse: makes a recording of its text.

    Raises:
        MotionError: the file is missing, no text, or cannot be used.
    """
    try:
        text = read_text(path)
        with warnings.catch_warnings(record=True) as doubts:
            warnings.simplefilter("always", UikaWarning)
            motion = to_motion(parse(text))
    except MotionError as error:
        raise MotionError(f"{path}: {error}") from error
    except (OSError, ValueError, TypeError, RecursionError, OverflowError) as error:
        raise MotionError(f"{path}: cannot be read as {kind} ({error})") from error
    for doubt in doubts:
        warnings.warn(f"{path}: {doubt.message}", UikaWarning, stacklevel=3)
    return motion


def to_motion(recording: Recording) -> Motion:
    """The recording as a motion of the ARKit actions in the order of `ARKIT_ACTIONS`.

    Rows without a face and missing numbers are filled in from their neighbours in time; an action that the file never
    mentions rests. Frames that were not taken at an even pace are resampled to the file's rate. Warns of what was
    filled in and of activations a little outside 0 to 1.

    Raises:
        MotionError: names or numbers cannot be used; the message says which.
    """
    seen = [row for row in recording.rows if row]
    names = list(dict.fromkeys(name for row in seen for name in row))
    actions = find_actions(names)
    rows = list(zip(recording.rows, recording.labels, strict=True))
    columns = {action: [_number(row, name, label) for row, label in rows] for name, action in actions.items()}
    _check(columns, recording.labels)
    _check_angles(columns, recording.labels)
    values = np.zeros((len(recording.rows), len(ARKIT_ACTIONS) + len(HEAD_ANGLES)))
    for place, name in enumerate((*ARKIT_ACTIONS, *HEAD_ANGLES)):
        if name in columns:
            values[:, place] = columns[name]
    blank = np.array([not row for row in recording.rows])
    missing = np.isnan(values)
    values, fps = _steady(_filled(values), recording)
    for text in (_of_gaps(blank, recording.labels), _of_holes(missing & ~blank[:, None])):
        if text:
            warnings.warn(text, UikaWarning, stacklevel=3)
    table = torch.from_numpy(values).float()
    count = len(ARKIT_ACTIONS)
    rest = {name: torch.zeros(len(table), size) for name, size in _SIZES.items()}
    return Motion(expression=table[:, :count], fps=fps, **{**rest, "neck": from_angles(table[:, count:])})


def read_number(text: str) -> float:
    """The number in a cell.

    Raises:
        ValueError: it is none; Python's own 1_000 is none to others.
    """
    if "_" in text:
        raise ValueError(f"no number: {text!r}")
    return float(text)


def _number(row: dict[str, Any] | None, name: str, label: str) -> float:
    """The number, or NaN for a gap; what a row with a face does not mention rests."""
    if not row:
        return math.nan
    if (value := row.get(name, 0.0)) is None:
        return math.nan
    kinds = {list: "a list", dict: "a group", bool: "true or false"}
    if type(value) in kinds:
        raise MotionError(f"'{name}' is no number but {kinds[type(value)]} in {label}")
    try:
        number = read_number(value) if isinstance(value, str) else float(value)
    except ValueError:
        raise MotionError(f"'{name}' is no number but '{value[:40]}' in {label}") from None
    if not math.isfinite(number):
        raise MotionError(f"'{name}' holds a value that is not finite in {label}")
    return number


def _check_angles(columns: dict[str, list[float]], labels: list[str]) -> None:
    """Refuse heads that turn further than half around: their angles are degrees."""
    for name in HEAD_ANGLES:
        wide = [place for place, value in enumerate(columns.get(name, ())) if abs(value) > math.pi]
        if wide:
            value = columns[name][wide[0]]
            raise MotionError(f"{name} is {value:g} in {labels[wide[0]]}; angles are radians (degrees? divide by 57.3)")


def _check(columns: dict[str, list[float]], labels: list[str]) -> None:
    """Refuse activations far outside [0,1]; warn of those a little outside."""
    table = np.array([columns[name] for name in ARKIT_ACTIONS if name in columns])
    names = [name for name in ARKIT_ACTIONS if name in columns]
    excess = np.nan_to_num(np.maximum(table - 1, -table), nan=0.0)
    column, row = np.unravel_index(int(excess.argmax()), excess.shape)
    if excess[column, row] <= _TOLERANCE:
        return
    value = table[column, row]
    what = f"{names[column]} is {value:g} in {labels[row]}; activations lie in 0 to 1"
    if not _LEAST <= value <= MOST or table[table == table].max() > MOST:
        raise MotionError(what + (" (percent? divide by 100)" if 0 < value <= 100.5 else ""))
    warnings.warn(f"{what}, {int((excess > _TOLERANCE).sum())} numbers do not; used as they are", UikaWarning, 4)


def _filled(values: NDArray[np.float64]) -> NDArray[np.float64]:
    rows = np.arange(len(values))
    for column in values.T:
        known = ~np.isnan(column)
        if not known.all():
            column[~known] = np.interp(rows[~known], rows[known], column[known]) if known.any() else 0.0
    return values


def _steady(values: NDArray[np.float64], recording: Recording) -> tuple[NDArray[np.float64], float]:
    """The values at an even pace, and its frames per second."""
    fps = recording.fps
    if fps is not None and not (math.isfinite(fps) and fps > 0):
        raise MotionError(f"has {fps} frames per second; it must be more than 0")
    times = None if recording.times is None else np.array(recording.times, dtype=np.float64)
    if times is None or len(times) < 2 or (fps is not None and (times == times[0]).all()):
        return values, FPS if fps is None else fps
    try:
        seconds = in_seconds(times)
        fps = rate_of(seconds) if fps is None else fps
        if is_even(seconds, fps):
            return values, fps
        return resampled(values, even_places(seconds, fps)), fps
    except ValueError as error:
        raise MotionError(str(error)) from error


def _of_gaps(blank: NDArray[np.bool_], labels: list[str]) -> str:
    where = np.flatnonzero(blank)
    if not len(where):
        return ""
    first = labels[where[0]]
    return f"no face in {len(where)} of {len(blank)} frames, the first at {first}; filled in from their neighbours"


def _of_holes(missing: NDArray[np.bool_]) -> str:
    count = int(missing.sum())
    return f"{count} numbers are missing; filled in from their neighbours" if count else ""


def from_angles(angles: Tensor) -> Tensor:
    """Axis-angle [T,3] of yaw about Y, then pitch about X, then roll about Z [T,3], radians."""
    from uika.head import rodrigues

    yaw, pitch, roll = (
        torch.zeros(len(angles), 3).index_copy(1, torch.tensor([axis]), angles[:, [k]])
        for k, axis in enumerate((1, 0, 2))
    )
    return axis_angles(rodrigues(yaw) @ rodrigues(pitch) @ rodrigues(roll))


def to_angles(rotation: Tensor) -> Tensor:
    """Yaw, pitch and roll [T,3] of axis-angle vectors [T,3]; the inverse of `from_angles`."""
    from uika.head import rodrigues

    m = rodrigues(rotation)
    yaw, roll = torch.atan2(m[:, 0, 2], m[:, 2, 2]), torch.atan2(m[:, 1, 0], m[:, 1, 1])
    return torch.stack((yaw, torch.asin((-m[:, 1, 2]).clamp(-1, 1)), roll), -1)


def axis_angles(matrix: Tensor) -> Tensor:
    """Axis-angle vectors [T,3] of rotations [T,3,3]."""
    twist = torch.stack(
        (matrix[:, 2, 1] - matrix[:, 1, 2], matrix[:, 0, 2] - matrix[:, 2, 0], matrix[:, 1, 0] - matrix[:, 0, 1]), -1
    )
    sine = twist.norm(dim=-1, keepdim=True) / 2
    angle = torch.atan2(sine, (matrix.diagonal(dim1=1, dim2=2).sum(-1, keepdim=True) - 1) / 2)
    return twist / 2 * torch.where(sine > 1e-9, angle / sine.clamp_min(1e-9), 1.0)
