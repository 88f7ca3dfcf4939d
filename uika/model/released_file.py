"""Reading released weight files: which keys they hold, which of them are not used, and how the rest reaches a model."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from uika.model.checkpoint import CheckpointError, listing

# Keys that belong to a released file and change no result here, with the reason.
UNUSED = {
    r".*\bmask_token": "stands for hidden patches while the backbone is pretrained",
    r"transformer\.layers\.<last>\.attn2?\.(add_q_proj|norm_added_q)\.\w+": "computes an update that is not used",
    r"renderer\.flame_model\.(shapedirs|posedirs|J_regressor|lbs_weights)_pix": "animation is done by `uika.head`",
    r"renderer\.flame_model\.(v_template|shapedirs|posedirs|J_regressor|parents|lbs_weights)": "the head model itself",
    r"renderer\.flame_model\.(full_lmk_faces_idx|full_lmk_bary_coords|neck_kin_chain)": "landmarks of the head model",
    r"renderer\.flame_model\.(uv_color_flatten|pix_to_face_flatten|faces|verts_uvs|textures_idx)": "for pictures only",
}
PREFIXES = {
    "encoder.": "network.encoder.",
    "transformer.": "network.transformer.",
    "gs_decoder.": "network.gs_decoder.",
}
ESTIMATOR, ESTIMATOR_FILE = "uv_wrapper.model.", "fuvt."
_TENSORS_AT_ONCE = 32


def unused_reason(name: str, last: str) -> str | None:
    """Why a key is not used; None if it is; `last` is the number of the last block."""
    return next((why for rule, why in UNUSED.items() if re.fullmatch(rule.replace("<last>", last), name)), None)


def read_shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Shapes of all tensors by name; raises CheckpointError for a file that is missing or damaged."""
    if not path.is_file():
        raise CheckpointError(f"{path}: no such model file")
    try:
        with safe_open(path, framework="pt") as file:
            return {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path}: damaged, truncated or no safetensors file ({error})") from error


def compare(
    path: Path,
    expected: Mapping[str, tuple[int, ...]],
    shapes: Mapping[str, tuple[int, ...]],
    names: Mapping[str, str],
    unexpected: list[str],
) -> None:
    """Raise CheckpointError if a model's tensors are not in a file with `shapes`, `names` being new -> old names."""
    missing = [name for name in expected if name not in names]
    wrong = [
        f"{names[name]} {list(shapes[names[name]])} instead of {list(shape)}"
        for name, shape in expected.items()
        if name in names and shapes[names[name]] != shape
    ]
    problems = [
        listing("missing", [_released(name) for name in missing]),
        listing("misshapen", wrong),
        listing("unknown (strict=False ignores these)", unexpected),
    ]
    if any(problems):
        raise CheckpointError(f"{path}: {'; '.join(filter(None, problems))}")


def _released(name: str) -> str:
    back = {new: old for old, new in PREFIXES.items()} | {"estimator.": ESTIMATOR}
    return next((old + name.removeprefix(new) for new, old in back.items() if name.startswith(new)), name)


def fill(model: nn.Module, path: Path, names: Mapping[str, str], expected: Mapping[str, Tensor]) -> None:
    """Give the model its tensors: views of the file where all types fit, else copies that do not hold on to it."""
    copy = any(value.dtype == torch.bfloat16 for value in expected.values())
    tensors = {new: tensor.to(expected[new].dtype, copy=copy) for new, tensor in read_tensors(path, names)}
    model.load_state_dict(tensors, strict=False, assign=True)
    model.requires_grad_(False)


def read_tensors(path: Path, names: Mapping[str, str]) -> Iterator[tuple[str, Tensor]]:
    """(new name, tensor) of each; the file is opened anew now and then, which gives back what was read of it."""
    waiting = list(names.items())
    for first in range(0, len(waiting), _TENSORS_AT_ONCE):
        with safe_open(path, framework="pt") as file:
            for new, old in waiting[first : first + _TENSORS_AT_ONCE]:
                yield new, file.get_tensor(old)
