"""BVH files of a head and its neck: rotations of joints in time, for animation programs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uika.head import rodrigues
from uika.head.actions import ARKIT_ACTIONS
from uika.io.files import check_output, replacing
from uika.io.text import read_text
from uika.motion.motion import Motion, MotionError
from uika.motion.recording import axis_angles, to_angles

_HEADS = ("head", "skull")
_ENDS = ("end", "top", "tip", "nub", "site")  # of what sits on a head
_ORDER = "Yrotation Xrotation Zrotation"  # yaw, pitch, roll: each about the axes that the one before has turned
_CENTIMETRES = 100.0  # units of the file in a metre, as motion capture programs have it
_MOST_CELLS = 50_000_000


def write_bvh(motion: Motion, path: str | Path) -> None:
    """Write the head's rotation and place, and the neck's rotation below it.

    BVH has no expressions; write `.csv` or `.json` for these.

    Args:
        motion: its `rotation`, `translation` and `neck` are written; centimetres and degrees.
        path: `.bvh` file.

    Raises:
        UikaError: wrong extension, or nothing can be written there.
    """
    target = check_output(path, ".bvh")
    lines = [
        "HIERARCHY",
        "ROOT Root",
        "{",
        "\tOFFSET 0 0 0",
        f"\tCHANNELS 6 Xposition Yposition Zposition {_ORDER}",
        "\tJOINT Head",
        "\t{",
        "\t\tOFFSET 0 7.4 1.9",
        f"\t\tCHANNELS 3 {_ORDER}",
        "\t\tEnd Site",
        "\t\t{",
        "\t\t\tOFFSET 0 20 0",
        "\t\t}",
        "\t}",
        "}",
        "MOTION",
        f"Frames: {len(motion)}",
        f"Frame Time: {1 / motion.fps:.9f}",
    ]
    place = motion.translation.double().numpy() * _CENTIMETRES
    rows = np.concatenate((place, _degrees(motion.rotation), _degrees(motion.neck)), 1)
    lines += [" ".join(f"{value:.6f}" for value in row) for row in rows]
    with replacing(target) as temporary:
        temporary.write_text("\n".join([*lines, ""]), encoding="utf-8")


def read_bvh(path: str | Path) -> Motion:
    """How the head of a BVH skeleton turns, as a motion without expressions.

    The rotations of the joint named as a head and of all above it, the root's first frame left out, turn the head
    about its neck; where a body stands does not matter.

    Raises:
        MotionError: the file is missing or damaged, or no joint is named as a head.
    """
    place = Path(path)
    try:
        return _parsed(read_text(place))
    except MotionError as error:
        raise MotionError(f"{place}: {error}") from error
    except (OSError, ValueError, IndexError) as error:
        raise MotionError(f"{place}: cannot be read as BVH ({error})") from error


def _parsed(text: str) -> Motion:
    head, _, body = text.partition("MOTION")
    joints, total = _joints(head.split())
    lines = [line for line in body.splitlines() if line.strip()]
    count, seconds = int(lines[0].split(":")[1]), float(lines[1].split(":")[1])
    if not count or len(lines) != count + 2 or count * total > _MOST_CELLS:
        raise MotionError(f"promises {count} frames and holds {len(lines) - 2}")
    if not seconds > 0:
        raise MotionError("has no frame time")
    cells = [[float(cell) for cell in line.split()] for line in lines[2:]]
    rows = np.array(cells) if {len(row) for row in cells} == {total} else np.zeros(0)
    if rows.shape != (count, total) or not np.isfinite(rows).all():
        raise MotionError(f"has rows that do not hold {total} finite numbers each")
    found = next((k for k, joint in enumerate(joints) if _is_head(joint.name)), None)
    if found is None:
        raise MotionError("has no joint named as a head")
    world = torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
    chain = [found]
    while (parent := joints[chain[-1]].parent) >= 0:
        chain.append(parent)
    for joint in reversed(chain):
        turn = _matrices(rows, joints[joint].turns)
        world = world @ (turn if joint != 0 else turn[:1].mT @ turn)
    still = torch.zeros(count, 3)
    neck = axis_angles(world).float()
    return Motion(torch.zeros(count, len(ARKIT_ACTIONS)), still, neck, still, torch.zeros(count, 6), still, 1 / seconds)


class _Joint(NamedTuple):
    name: str
    parent: int  # -1 of a root
    turns: list[
        tuple[int, str]
    ]  # column of the table and axis of each rotation, in the order in which they are applied


def _joints(words: list[str]) -> tuple[list[_Joint], int]:
    """The joints of a hierarchy in the order of their channels, and how many channels there are."""
    if not words or words[0] != "HIERARCHY":
        raise MotionError("does not begin with HIERARCHY")
    joints: list[_Joint] = []
    open_: list[int] = []  # joints whose braces are open; -1 is an end site
    column, at = 0, 1
    while at < len(words):
        word = words[at]
        if word in ("ROOT", "JOINT"):
            end = words.index("{", at)
            joints.append(_Joint(" ".join(words[at + 1 : end]), open_[-1] if open_ else -1, []))
            open_.append(len(joints) - 1)
            at = end
        elif word == "End":
            open_.append(-1)
            at += 1
        elif word == "CHANNELS":
            count = int(words[at + 1])
            if count < 0:
                raise MotionError(f"a joint has {count} channels")
            for number, channel in enumerate(words[at + 2 : at + 2 + count]):
                if channel[1:] == "rotation" and channel[0] in "XYZ":
                    joints[open_[-1]].turns.append((column + number, channel[0]))
            column += count
            at += 1 + count
        elif word == "}":
            open_.pop()
        at += 1
    return joints, column


def _matrices(rows: NDArray[np.float64], turns: list[tuple[int, str]]) -> Tensor:
    """Rotations [T,3,3] of one joint."""
    result = torch.eye(3, dtype=torch.float64).expand(len(rows), 3, 3)
    for column, axis in turns:
        vectors = np.zeros((len(rows), 3))
        vectors[:, "XYZ".index(axis)] = np.radians(rows[:, column])
        result = result @ rodrigues(torch.from_numpy(vectors))
    return result


def _is_head(name: str) -> bool:
    """Whether a joint's name says head, whatever programs put around it: mixamorig:Head, Bip01 Head, CC_Base_Head."""
    words = re.split(r"[\s:_.|-]+", name.lower())
    return any(word.removeprefix("mixamorig") in _HEADS for word in words) and not set(words) & set(_ENDS)


def _degrees(turn: Tensor) -> NDArray[np.float64]:
    """Yaw, pitch and roll [T,3] of axis-angle vectors [T,3]."""
    return np.degrees(to_angles(turn.double()).numpy())
