"""Write a motion in any known format."""

from __future__ import annotations

from pathlib import Path

from uika.head import HeadModel
from uika.head.actions import has_actions
from uika.io.files import check_output
from uika.motion.arkit import write_csv, write_json
from uika.motion.bvh import write_bvh
from uika.motion.flame import write_flame_params
from uika.motion.motion import Motion, MotionError, save_motion

KINDS = (".npz", ".csv", ".json", ".bvh")
FLAME_NAME = "flame_param.npz"  # as VHAP and GaussianAvatars call their files


def check_motion_output(path: str | Path) -> Path:
    """Refuse a path that `write_motion` could not write.

    Raises:
        UikaError: wrong extension, or a place where nothing can be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in KINDS:
        raise MotionError(f"{path}: a motion's name must end in {', '.join(KINDS)}")
    return check_output(path, suffix)


def write_motion(motion: Motion, path: str | Path, head: HeadModel) -> None:
    """Write a motion of `head`; the name says how.

    `.npz` is this program's own (`load_motion`), but a file called `flame_param.npz` holds FLAME parameters as VHAP has
    them; `.csv` is a Live Link Face table, `.json` named ARKit activations, `.bvh` the rotations of head and neck.

    Raises:
        MotionError: the extension is unknown, or the head has not the expressions that the format holds.
        UikaError: the file cannot be written.
    """
    target = check_motion_output(path)
    suffix = target.suffix.lower()
    if target.name == FLAME_NAME:
        if has_actions(head):
            raise MotionError(
                f"{target}: holds motions of a FLAME head; '{head.id}' has ARKit actions (--head FLAME.npz)"
            )
        write_flame_params(motion, target)
    elif suffix == ".npz":
        save_motion(motion, target, head)
    elif suffix == ".bvh":
        write_bvh(motion, target)
    else:
        (write_csv if suffix == ".csv" else write_json)(motion, target, head.expression_names)
