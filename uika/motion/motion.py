"""Motions: how a head's expression and pose change from frame to frame, and where the camera goes meanwhile."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from uika.errors import UikaError
from uika.head import HeadModel, HeadParameters
from uika.io.files import check_output, replacing
from uika.io.npz import ArraysError, read_npz

_SIZES = {"rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3}
_CAMERA = ("yaw", "pitch")
_MAX_FRAMES = 100_000
_MAX_FPS = 240.0


class MotionError(UikaError):
    """A motion, or its file, that cannot be used; the message says which and what to do."""


@dataclass(frozen=True, eq=False)
class Motion:
    """T frames of a head's movement, for any identity; float32.

    Fields are those of `HeadParameters` with one leading dimension T, and the camera's path where the motion has one.
    """

    expression: Tensor  # [T,E] activations
    rotation: Tensor  # [T,3] axis-angle of the root, radians
    neck: Tensor  # [T,3]
    jaw: Tensor  # [T,3]
    eyes: Tensor  # [T,6] left, then right
    translation: Tensor  # [T,3] metres
    fps: float  # frames per second
    yaw: Tensor | None = None  # [T] degrees, the camera moves to the subject's left
    pitch: Tensor | None = None  # [T] degrees, the camera moves up

    def __post_init__(self) -> None:
        """Check shapes and values.

        Raises:
            MotionError: a tensor does not fit, is not finite, or the frame rate is out of range.
        """
        count = len(self.expression) if self.expression.ndim == 2 else 0
        if not 1 <= count <= _MAX_FRAMES:
            found = list(self.expression.shape)
            raise MotionError(f"motion array 'expression' must be [T,E] with 1 to {_MAX_FRAMES} frames, not {found}")
        for name, shape in {**{k: (count, v) for k, v in _SIZES.items()}, **{k: (count,) for k in _CAMERA}}.items():
            tensor = getattr(self, name)
            if tensor is not None and tuple(tensor.shape) != shape:
                raise MotionError(f"motion array '{name}' has shape {list(tensor.shape)} where {list(shape)} is needed")
        for name, tensor in self.tensors().items():
            if not bool(torch.isfinite(tensor).all()):
                first = int((~torch.isfinite(tensor)).nonzero()[0, 0])
                raise MotionError(f"motion array '{name}' holds values that are not finite, first in frame {first}")
        if not 0 < self.fps <= _MAX_FPS:
            raise MotionError(
                f"motion has {self.fps} frames per second; it must be more than 0 and at most {_MAX_FPS:g}"
            )

    def __len__(self) -> int:
        """The number of frames."""
        return len(self.expression)

    def tensors(self) -> dict[str, Tensor]:
        """The tensors that the motion has, by name."""
        found = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: value for name, value in found.items() if isinstance(value, Tensor)}

    def parameters(self, identity: Tensor) -> HeadParameters:
        """Head parameters with batch dimension T of a person with `identity` [K]."""
        shared = identity.expand(len(self), -1)
        return HeadParameters(shared, self.expression, self.rotation, self.neck, self.jaw, self.eyes, self.translation)

    def resampled(self, fps: float) -> Motion:
        """The same movement in the same time at another frame rate, interpolated linearly."""
        if fps == self.fps:
            return self
        if not 0 < fps <= _MAX_FPS:
            raise MotionError(f"fps must be more than 0 and at most {_MAX_FPS:g}, not {fps}")
        count = max(1, round(len(self) * fps / self.fps))
        place = (torch.arange(count, dtype=torch.float64) * self.fps / fps).clamp_max(len(self) - 1)
        before = place.floor().long()
        after = (before + 1).clamp_max(len(self) - 1)
        share = (place - before).float()
        mixed = {
            name: torch.lerp(value[before], value[after], share.view(-1, *(1,) * (value.ndim - 1)))
            for name, value in self.tensors().items()
        }
        return Motion(fps=fps, **mixed)


def load_motion(path: str | Path, head: HeadModel) -> Motion:
    """Read a motion file.

    The file is an `.npz` of plain arrays named as the fields of `Motion`: `fps` (a number) and any of `expression`
    [T,E], `rotation`, `neck`, `jaw`, `translation` [T,3], `eyes` [T,6], `yaw`, `pitch` [T]; what is missing rests.
    With `expression_names` [E], columns are matched to the head's actions by name.

    Raises:
        MotionError: the file is missing, damaged, has unknown arrays, or does not fit the head; it names the file.
    """
    source = Path(path)
    if not source.is_file():
        raise MotionError(f"{source}: no such motion file")
    try:
        arrays = read_npz(source)
    except ArraysError as error:
        raise MotionError(f"{source}: cannot be read as an .npz of plain arrays ({error})") from error
    try:
        return _from_arrays(arrays, head)
    except MotionError as error:
        raise MotionError(f"{source}: {error}") from error


def save_motion(motion: Motion, path: str | Path, head: HeadModel) -> None:
    """Write a motion file that `load_motion` reads back bit for bit, also for another head with the same actions.

    Raises:
        MotionError: the motion does not fit the head.
        UikaError: the file cannot be written.
    """
    if motion.expression.shape[1] != len(head.expression_names):
        raise MotionError(
            f"the motion has {motion.expression.shape[1]} expressions; the head model '{head.id}' "
            f"has {len(head.expression_names)}"
        )
    arrays = {name: value.numpy() for name, value in motion.tensors().items()}
    names = np.array(head.expression_names, dtype=np.str_)
    with replacing(check_output(path, ".npz")) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, fps=np.float64(motion.fps), expression_names=names, **arrays)  # type: ignore[arg-type]


def _from_arrays(arrays: dict[str, np.ndarray], head: HeadModel) -> Motion:
    known = {f.name for f in fields(Motion)} | {"expression_names"}
    if unknown := sorted(set(arrays) - known):
        raise MotionError(f"has arrays that no motion has: {', '.join(unknown[:5])}")
    if "fps" not in arrays or arrays["fps"].size != 1:
        raise MotionError("needs the array 'fps' with one number")
    names = arrays.pop("expression_names", None)
    for name, array in arrays.items():
        if not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
            raise MotionError(f"array '{name}' must hold real numbers, not {array.dtype}")
    values = {name: torch.from_numpy(array.astype(np.float32)) for name, array in arrays.items()}
    del values["fps"]
    fps = float(arrays["fps"].item())  # not through single precision: 23.976 must stay what it is
    if not values or any(value.ndim == 0 for value in values.values()):
        raise MotionError("needs at least one array of frames besides 'fps', such as 'expression' [T,E]")
    if names is not None and "expression" in values:
        values["expression"] = _by_name(values["expression"], [str(name) for name in names.flatten()], head)
    count = len(next(iter(values.values())))
    rest = {"expression": len(head.expression_names), **_SIZES}
    complete = {name: values.get(name, torch.zeros(count, size)) for name, size in rest.items()}
    motion = Motion(fps=fps, yaw=values.get("yaw"), pitch=values.get("pitch"), **complete)
    if motion.expression.shape[1] != len(head.expression_names):
        raise MotionError(
            f"array 'expression' has {motion.expression.shape[1]} columns; the head model '{head.id}' "
            f"has {len(head.expression_names)} expressions"
        )
    return motion


def _by_name(columns: Tensor, names: list[str], head: HeadModel) -> Tensor:
    if columns.ndim != 2 or columns.shape[1] != len(names):
        raise MotionError(
            f"array 'expression' has shape {list(columns.shape)}, but there are {len(names)} names for it"
        )
    if unknown := sorted(set(names) - set(head.expression_names)):
        raise MotionError(f"names expressions that the head model '{head.id}' lacks: {', '.join(unknown[:5])}")
    result = columns.new_zeros(len(columns), len(head.expression_names))
    result[:, [head.expression_names.index(name) for name in names]] = columns
    return result
