"""Give a bare head model the landmarks and masks that fitting needs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from uika.head import HeadError, HeadModel, save_head
from uika.head.face_paint import eyeballs, paint
from uika.head_import.bust import with_bust
from uika.head_import.flame_file import read_flame
from uika.head_import.landmark_embedding import embed
from uika.head_import.masks import region_masks
from uika.head_import.unpickle import UnpickleError, read_arrays
from uika.io.files import check_output, replacing

# Mask of ours -> index lists of the FLAME masks file that make it up.
_FLAME_MASKS = {
    "face": ("face",),
    "lips": ("lips",),
    "ears": ("left_ear", "right_ear"),
    "scalp": ("scalp",),
    "neck": ("neck", "boundary"),
    "eyeballs": ("left_eyeball", "right_eyeball"),
}


def _silent(step: str) -> None:
    """Tell nobody."""


def adopt(head: HeadModel, say: Callable[[str], None] = _silent) -> HeadModel:
    """A copy of `head` with embedded landmarks and region masks.

    The face mesh detector looks at pictures of the painted mean head, so the result depends on nothing but the head.

    Args:
        head: the bare head.
        say: told what is being done.

    Raises:
        HeadError: no face is found on it.
    """
    say("finding landmarks")
    skin = (eyeballs(head) > 0) | (head.lbs_weights[:, :3].sum(-1) > 0.5)
    ids, triangles, mix, trust = embed(head, paint(head), skin[head.faces].all(-1))
    marked = replace(
        head, landmark_ids=ids, landmark_faces=triangles, landmark_barycentrics=mix, landmark_weights=trust
    )
    say("marking regions")
    return replace(marked, masks=region_masks(marked))


def import_flame(
    path: str | Path,
    output: str | Path,
    obj: str | Path | None = None,
    masks: str | Path | None = None,
    eyelids: Sequence[str | Path] = (),
    say: Callable[[str], None] = _silent,
    *,
    bust: bool = True,
) -> HeadModel:
    """Convert a FLAME model file to a head file for `--head` or `UIKA_HEAD`.

    Args:
        path: FLAME model, pickle or `.npz`; see `uika.head_import.flame_file.read_flame`.
        output: the head file to write, `.npz`.
        obj: Wavefront file with the texture coordinates.
        masks: FLAME's masks file (a pickle of index lists), used instead of the masks found from the geometry.
        eyelids: two `.npy` files with the displacement of shut lids, left and right.
        say: told what is being done, step by step.
        bust: whether to continue the head by neck, shoulders and chest, see `uika.head_import.bust`.

    Raises:
        HeadError: a file cannot be used; the message names it.
        UikaError: the output cannot be written.
    """
    target = check_output(output, ".npz")
    say(f"reading {path}")
    head = read_flame(path, obj, eyelids)
    given = {} if masks is None else _read_masks(Path(masks), len(head.template))
    head = adopt(head, say)
    head = replace(head, masks={**head.masks, **given})
    if bust:
        say("adding the bust")
        head = with_bust(head)
    say(f"writing {target}")
    with replacing(target) as temporary:
        save_head(head, temporary)
    return head


def _read_masks(path: Path, vertices: int) -> Mapping[str, Tensor]:
    if not path.is_file():
        raise HeadError(f"{path}: no such masks file")
    try:
        lists = read_arrays(path)
    except UnpickleError as error:
        raise HeadError(str(error)) from error
    result = {}
    for name, parts in _FLAME_MASKS.items():
        if found := [lists[part] for part in parts if part in lists]:
            if any(part.dtype.kind not in "iu" for part in found):
                raise HeadError(f"{path}: mask '{name}' is no list of vertex numbers")
            index = torch.cat([torch.from_numpy(part.astype("int64").reshape(-1)) for part in found])
            if len(index) and not 0 <= int(index.min()) <= int(index.max()) < vertices:
                raise HeadError(f"{path}: mask '{name}' points outside the {vertices} vertices")
            result[name] = torch.zeros(vertices).index_fill(0, index, 1.0)
    if not result:
        raise HeadError(f"{path}: holds none of the masks of FLAME ({', '.join(_FLAME_MASKS)})")
    return result
