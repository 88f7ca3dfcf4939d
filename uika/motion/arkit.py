"""ARKit activations: Live Link Face tables and JSON of named actions."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from uika.head.actions import ARKIT_ACTIONS
from uika.io.files import check_output, replacing
from uika.motion.motion import Motion, MotionError

FPS = 60.0  # of phones, where the file does not say
_HEAD_ANGLES = ("headYaw", "headPitch", "headRoll")
_SIZES = {"rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3}
_TIME = re.compile(r"(\d+):(\d+):(\d+)[:;.](\d+(?:\.\d+)?)")
_PLACE = {name: index for index, name in enumerate(ARKIT_ACTIONS)}


def read_csv(path: str | Path) -> Motion:
    """A Live Link Face recording as a motion of the ARKit actions in the order of `ARKIT_ACTIONS`.

    Head angles become the root's rotation: yaw about Y, then pitch about X, then roll about Z, radians. The frame rate
    follows from the timecodes; 60 where they span less than two seconds.

    Raises:
        MotionError: the file is missing or damaged, or has no column named as an action.
    """
    place = Path(path)
    try:
        with place.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if any(cell.strip() for cell in row)]
    except (OSError, ValueError, csv.Error) as error:
        raise MotionError(f"{place}: cannot be read as a table ({error})") from error
    columns = {_action(name): index for index, name in enumerate(rows[0])} if rows else {}
    if not set(columns) & set(ARKIT_ACTIONS):
        raise MotionError(f"{place}: its first line names no ARKit actions such as EyeBlinkLeft")
    body = rows[1:]

    def values(names: Sequence[str]) -> Tensor:
        cells = [[float(row[columns[name]]) if name in columns else 0.0 for name in names] for row in body]
        return torch.tensor(cells).reshape(len(body), len(names))

    try:
        stamps = [row[columns["timecode"]] for row in body] if "timecode" in columns else []
        return _motion(values(ARKIT_ACTIONS), _frame_rate(stamps), _from_angles(values(_HEAD_ANGLES)))
    except (ValueError, IndexError) as error:
        raise MotionError(f"{place}: a line is damaged or has missing cells ({error})") from error


def write_csv(motion: Motion, path: str | Path, names: Sequence[str]) -> None:
    """Write activations as a Live Link Face table.

    Args:
        motion: its expressions are the activations.
        path: `.csv` file.
        names: the actions that the motion's columns stand for; actions that it lacks are written as 0.

    Raises:
        MotionError: the names are not actions or not one for each column.
    """
    values, angles = _ordered(motion, names), _to_angles(motion.rotation)
    header = ["timecode", "blendShapeCount", *ARKIT_ACTIONS, *_HEAD_ANGLES]
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

    Understood are one pose {"jawOpen": 0.2, ...}; a list of poses; {"fps": 30, "frames": [pose, ...]}; and
    {"fps": 30, "names": [...], "frames": [[...], ...]}. A pose may lie inside "blendShapes" or "weights".

    Raises:
        MotionError: the file is missing, no JSON of these kinds, or names none of the actions.
    """
    place = Path(path)
    try:
        content = json.loads(place.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise MotionError(f"{place}: cannot be read as JSON ({error})") from error
    try:
        poses, fps = _poses(content)
        named = [{_action(name): value for name, value in pose.items()} for pose in poses]
        if not any(set(pose) & set(ARKIT_ACTIONS) for pose in named):
            raise MotionError("names no ARKit actions such as jawOpen")
        return _motion(torch.tensor([[float(pose.get(name, 0.0)) for name in ARKIT_ACTIONS] for pose in named]), fps)
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise MotionError(f"{place}: {error}") from error


def write_json(motion: Motion, path: str | Path, names: Sequence[str]) -> None:
    """Write activations as {"fps": ..., "frames": [{name: value, ...}, ...]} with all 52 actions; see `write_csv`."""
    frames = [dict(zip(ARKIT_ACTIONS, row, strict=True)) for row in _ordered(motion, names).tolist()]
    with replacing(check_output(path, ".json")) as temporary:
        temporary.write_text(json.dumps({"fps": motion.fps, "frames": frames}), encoding="utf-8")


def _action(name: str) -> str:
    name = str(name).strip()
    return name[:1].lower() + name[1:]


def _motion(actions: Tensor, fps: float, rotation: Tensor | None = None) -> Motion:
    rest = {name: torch.zeros(len(actions), size) for name, size in _SIZES.items()}
    return Motion(expression=actions, fps=fps, **{**rest, **({} if rotation is None else {"rotation": rotation})})


def _ordered(motion: Motion, names: Sequence[str]) -> Tensor:
    """Activations [T,52] in the order of `ARKIT_ACTIONS`."""
    if len(names) != motion.expression.shape[1] or not set(names) & set(ARKIT_ACTIONS):
        raise MotionError("only motions of a head with ARKit actions can be written as ARKit activations")
    result = torch.zeros(len(motion), len(ARKIT_ACTIONS))
    for column, name in enumerate(names):
        if name in _PLACE:
            result[:, _PLACE[name]] = motion.expression[:, column]
    return result


def _poses(content: Any) -> tuple[list[dict[str, Any]], float]:
    fps = FPS
    if isinstance(content, dict):
        fps = float(content["fps"] if "fps" in content else content.get("frameRate", FPS))
        frames = content.get("frames")
        if frames is None:
            frames = [content]
        elif "names" in content:
            frames = [dict(zip(content["names"], frame, strict=True)) for frame in frames]
    else:
        frames = content
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise MotionError("needs one pose {action: value} or a list of them")
    poses = []
    for frame in frames:
        inner = next((frame[key] for key in ("blendShapes", "blendshapes", "weights") if key in frame), frame)
        poses.append(inner)
    return poses, fps


def _frame_rate(stamps: list[str]) -> float:
    """Frames per second from the seconds in the timecodes; frames within a second may be missing."""
    seconds = []
    for stamp in stamps:
        if (match := _TIME.match(stamp.strip())) is None:
            return FPS
        hours, minutes, whole = (int(match[k]) for k in (1, 2, 3))
        seconds.append(3600 * hours + 60 * minutes + whole)
    changes = [index for index in range(1, len(seconds)) if seconds[index] != seconds[index - 1]]
    if len(changes) < 2:
        return FPS
    elapsed = seconds[changes[-1]] - seconds[changes[0]]
    rate = (changes[-1] - changes[0]) / elapsed if elapsed > 0 else FPS
    return float(round(rate)) if 1 <= rate <= 240 else FPS


def _from_angles(angles: Tensor) -> Tensor:
    """Axis-angle [T,3] of yaw, pitch and roll [T,3]."""
    from uika.head import rodrigues

    yaw, pitch, roll = (
        torch.zeros(len(angles), 3).index_copy(1, torch.tensor([axis]), angles[:, [k]])
        for k, axis in enumerate((1, 0, 2))
    )
    return _axis_angle(rodrigues(yaw) @ rodrigues(pitch) @ rodrigues(roll))


def _to_angles(rotation: Tensor) -> Tensor:
    from uika.head import rodrigues

    m = rodrigues(rotation)
    yaw, roll = torch.atan2(m[:, 0, 2], m[:, 2, 2]), torch.atan2(m[:, 1, 0], m[:, 1, 1])
    return torch.stack((yaw, torch.asin((-m[:, 1, 2]).clamp(-1, 1)), roll), -1)


def _axis_angle(matrix: Tensor) -> Tensor:
    twist = torch.stack(
        (matrix[:, 2, 1] - matrix[:, 1, 2], matrix[:, 0, 2] - matrix[:, 2, 0], matrix[:, 1, 0] - matrix[:, 0, 1]), -1
    )
    sine = twist.norm(dim=-1, keepdim=True) / 2
    angle = torch.atan2(sine, (matrix.diagonal(dim1=1, dim2=2).sum(-1, keepdim=True) - 1) / 2)
    return twist / 2 * torch.where(sine > 1e-9, angle / sine.clamp_min(1e-9), 1.0)
