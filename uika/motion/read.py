"""Read any known kind of motion for a given head."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from torch import Tensor

from uika.assets import HEAD
from uika.head import HeadModel, load_head
from uika.head.actions import ARKIT_ACTIONS, has_actions
from uika.motion.arkit import read_csv, read_json
from uika.motion.bvh import read_bvh
from uika.motion.flame import is_flame_params, read_flame_params
from uika.motion.motion import Motion, MotionError, load_motion
from uika.motion.vrm_animation import read_vrma

KINDS = (".npz", ".csv", ".json", ".bvh", ".vrma")


def read_motion(path: str | Path, head: HeadModel, source: HeadModel | None = None) -> Motion:
    """Read a motion of any known kind for `head`.

    Known are our own `.npz`; FLAME parameters, one `.npz` with `expr` [T,E] or a folder with one for each frame; ARKit
    `.csv` (Live Link Face) and `.json` (named activations); `.vrma`, animations of VRM avatars; `.bvh`, whose head
    turns and has no expressions. Expressions of another kind than the head's are transferred with
    `uika.motion.retargeting`.

    Args:
        path: file or folder.
        head: the head that will move.
        source: the FLAME head that FLAME expressions belong to, needed when `head` has ARKit actions.

    Raises:
        MotionError: the file is missing, damaged or of an unknown kind, or a FLAME head is needed and not given.
    """
    place = Path(path)
    if place.is_dir() or (place.suffix.lower() == ".npz" and is_flame_params(place)):
        return _from_flame(read_flame_params(place), head, source, place)
    if place.suffix.lower() == ".npz":
        return load_motion(place, head)
    if place.suffix.lower() == ".csv":
        return for_head(read_csv(place), head)
    if place.suffix.lower() == ".json":
        return for_head(read_json(place), head)
    if place.suffix.lower() == ".bvh":
        return for_head(read_bvh(place), head)
    if place.suffix.lower() == ".vrma":
        return for_head(read_vrma(place), head)
    raise MotionError(f"{place}: is no motion; known are {', '.join(KINDS)} and folders of FLAME parameters")


def for_head(motion: Motion, head: HeadModel) -> Motion:
    """A motion of the ARKit actions, in the order of `ARKIT_ACTIONS`, in a head's own expressions."""
    if not has_actions(head):
        from uika.motion.retargeting import transfer

        builtin = load_head(HEAD)
        return transfer(for_head(motion, builtin), builtin, head)
    columns = motion.expression.new_zeros(len(motion), len(head.expression_names))
    columns[:, [head.expression_names.index(name) for name in ARKIT_ACTIONS]] = motion.expression
    return replace(motion, expression=columns)


def _from_flame(motion: Motion, head: HeadModel, source: HeadModel | None, place: Path) -> Motion:
    if not has_actions(head):
        return replace(motion, expression=_padded(motion.expression, head, place))
    if source is None:
        raise MotionError(
            f"{place}: holds FLAME expressions, but the head model '{head.id}' has ARKit actions; also give the FLAME "
            "head that they belong to (`uika head import` makes it from FLAME's own file)"
        )
    from uika.motion.retargeting import transfer, turned_by_the_neck

    moved = transfer(replace(motion, expression=_padded(motion.expression, source, place)), source, head)
    return moved if head.bust is None else turned_by_the_neck(moved, head)


def _padded(expression: Tensor, head: HeadModel, place: Path) -> Tensor:
    """Columns for all of the head's expressions; what the file lacks rests."""
    count, have = len(head.expression_names), expression.shape[1]
    if have > count and bool((expression[:, count:] != 0).any()):
        raise MotionError(f"{place}: uses {have} expressions; the head model '{head.id}' has {count}")
    columns = expression.new_zeros(len(expression), count)
    columns[:, : min(have, count)] = expression[:, :count]
    return columns
