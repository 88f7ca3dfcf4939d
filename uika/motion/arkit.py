"""ARKit activations: Live Link Face tables and JSON of named actions."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from uika.head.actions import ARKIT_ACTIONS
from uika.head.rotations import rodrigues
from uika.io.files import check_output, replacing
from uika.motion.action_names import HEAD_ANGLES
from uika.motion.arkit_json import parse
from uika.motion.motion import Motion, MotionError
from uika.motion.recording import Recording, axis_angles, from_file, read_number, to_angles

_TIMECODE = re.compile(r"(\d{1,4}):(\d{1,4}):(\d{1,4})[:;.](\d{1,4}(?:\.\d+)?)")
_RATES = (24, 25, 30, 48, 50, 60, 100, 120, 240)  # what the last part of a timecode counts, frames per second
_NUMBERED = ("timestamp", "time", "seconds")
_PLACE = {name: index for index, name in enumerate(ARKIT_ACTIONS)}


def read_csv(path: str | Path) -> Motion:
    """A Live Link Face recording, or another table of named activations, as a motion in the order of `ARKIT_ACTIONS`.

    Head angles become the neck's rotation: yaw about Y, then pitch about X, then roll about Z, radians. The frame rate
    follows from the timecodes, or from a column of times; 60 where they span less than two seconds. Cells may be parted
    by commas, semicolons (then with decimal commas) or tabs. Rows without a face, which Live Link Face writes with a
    `BlendShapeCount` of 0, are filled in from their neighbours; see `uika.motion.recording.to_motion`.

    Raises:
        MotionError: the file is missing or damaged, has no column named as an action, or one that is not understood.
    """
    return from_file(Path(path), "a table", _table)


def _table(text: str) -> Recording:
    first = text.lstrip().partition("\n")[0]
    mark = max(",;\t", key=first.count)
    lines = csv.reader(io.StringIO(text, newline=""), delimiter=mark)
    try:
        rows = [(lines.line_num, row) for row in lines if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise MotionError(f"line {lines.line_num} is damaged ({error})") from error
    if not rows:
        raise MotionError("its first line names no ARKit actions such as EyeBlinkLeft; the file is empty")
    if not rows[0][1][0].strip():  # tables of Python programs begin with a nameless column that counts the rows
        rows = [(line, row[1:]) for line, row in rows]
    names = [cell.strip() for cell in rows[0][1]]
    while names and not names[-1]:  # spreadsheets end lines with a mark
        names.pop()
    plain = {name.lower(): index for index, name in enumerate(names)}
    found: list[dict[str, float | None] | None] = []
    for line, row in rows[1:]:
        cells = [cell.strip().replace(",", ".") if mark == ";" else cell.strip() for cell in row]
        found.append(_cells(names, plain, cells, line))
    if not found:
        raise MotionError("has no rows below its names")
    times, fps = _times(plain, [row for _, row in rows[1:]])
    return Recording(found, [f"line {line}" for line, _ in rows[1:]], times, fps)


def _cells(names: list[str], plain: dict[str, int], cells: list[str], line: int) -> dict[str, float | None] | None:
    """Numbers of one row by name; None where it has no face."""
    count = plain.get("blendshapecount")
    if count is not None and count < len(cells) and cells[count] in ("0", "0.0"):
        return None
    if len(cells) < len(names) or any(cells[len(names) :]):
        raise MotionError(f"line {line} is damaged or has missing cells: {len(cells)} for {len(names)} names")
    values: dict[str, float | None] = {}
    for name, cell in zip(names, cells, strict=False):
        if name.lower() == "timecode":
            continue
        try:
            values[name] = read_number(cell) if cell else None
        except ValueError:
            raise MotionError(f"line {line} is damaged: {name} is {cell[:40]!r}") from None
    faces = [value for name, value in values.items() if name.lower() not in (*_NUMBERED, "frame", "blendshapecount")]
    return None if all(value is None for value in faces) else values


def write_csv(motion: Motion, path: str | Path, names: Sequence[str]) -> None:
    """Write activations as a Live Link Face table.

    Args:
        motion: its expressions are the activations.
        path: `.csv` file.
        names: the actions that the motion's columns stand for; actions that it lacks are written as 0.

    Raises:
        MotionError: the names are not actions or not one for each column.
    """
    values, angles = _ordered(motion, names), to_angles(_head_turn(motion))
    header = ["timecode", "blendShapeCount", *ARKIT_ACTIONS, *HEAD_ANGLES]
    with replacing(check_output(path, ".csv")) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(name[0].upper() + name[1:] for name in header)
        for index, (row, angle) in enumerate(zip(values.tolist(), angles.tolist(), strict=True)):
            second, frame = divmod(index / motion.fps, 1.0)
            whole = int(second)
            stamp = f"{whole // 3600:02d}:{whole // 60 % 60:02d}:{whole % 60:02d}:{frame * motion.fps:06.3f}"
            writer.writerow([stamp, len(ARKIT_ACTIONS), *row, *angle])


def read_json(path: str | Path) -> Motion:
    """Named activations, in any order, as a motion of the ARKit actions in the order of `ARKIT_ACTIONS`.

    Understood are one pose {"jawOpen": 0.2, ...}; a list of poses, or one on each line; {"fps": 30, "frames": [pose,
    ...]}; {"names": [...], "frames": [[...], ...]}, also with the numbers inside "weights" (LAM, BEAT) or as
    {"facsNames", "weightMat"} (Audio2Face); {"jawOpen": [...], ...}; and lists of MediaPipe's categories. A pose may
    lie inside "blendShapes" or "weights". Frames that bear a "time" or "timestamp" keep it; without times and rate
    there are 60 a second. Empty poses and nulls are filled in; see `uika.motion.recording.to_motion`.

    Raises:
        MotionError: the file is missing, no JSON of these kinds, names none of the actions or what is none.
    """
    return from_file(Path(path), "JSON", parse)


def write_json(motion: Motion, path: str | Path, names: Sequence[str]) -> None:
    """Write activations as {"fps": ..., "frames": [{name: value, ...}, ...]} with all 52 actions; see `write_csv`."""
    frames = [dict(zip(ARKIT_ACTIONS, row, strict=True)) for row in _ordered(motion, names).tolist()]
    with replacing(check_output(path, ".json")) as temporary:
        temporary.write_text(json.dumps({"fps": motion.fps, "frames": frames}), encoding="utf-8")


def _head_turn(motion: Motion) -> Tensor:
    """Axis-angle [T,3] of the head, whether root or neck turn it."""
    return axis_angles(rodrigues(motion.rotation) @ rodrigues(motion.neck))


def _ordered(motion: Motion, names: Sequence[str]) -> Tensor:
    """Activations [T,52] in the order of `ARKIT_ACTIONS`."""
    if len(names) != motion.expression.shape[1] or not set(names) & set(ARKIT_ACTIONS):
        raise MotionError("only motions of a head with ARKit actions can be written as ARKit activations")
    result = torch.zeros(len(motion), len(ARKIT_ACTIONS))
    for column, name in enumerate(names):
        if name in _PLACE:
            result[:, _PLACE[name]] = motion.expression[:, column]
    return result


def _times(plain: dict[str, int], rows: list[list[str]]) -> tuple[list[float] | None, float | None]:
    """Times of the rows, in seconds for timecodes, and the frame rate where times do not tell it."""
    if "timecode" in plain:
        return _from_timecodes([row[plain["timecode"]] if plain["timecode"] < len(row) else "" for row in rows])
    for name in _NUMBERED:
        if name in plain:
            try:
                return [float(row[plain[name]].replace(",", ".")) for row in rows], None
            except (ValueError, IndexError):
                return None, None
    return None, None


def _from_timecodes(stamps: list[str]) -> tuple[list[float] | None, float | None]:
    seconds, frames = [], []
    for stamp in stamps:
        if (match := _TIMECODE.match(stamp.strip())) is None:
            return None, None
        seconds.append(3600 * int(match[1]) + 60 * int(match[2]) + int(match[3]))
        frames.append(float(match[4]))
    if len(set(seconds)) < 3:  # no whole second, whose last frame would tell the rate
        return None, None
    counted = next((rate for rate in _RATES if max(frames) < rate), None)
    if counted is None:
        return None, None
    days = 0
    times = []
    for index, (second, frame) in enumerate(zip(seconds, frames, strict=True)):
        if index and second < seconds[index - 1] - 43200:  # past midnight
            days += 1
        times.append(86400 * days + second + frame / counted)
    return times, None
