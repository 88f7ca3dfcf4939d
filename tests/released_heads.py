"""Small files under the released names for a made-up FLAME: random weights, and the tables of that head."""

from pathlib import Path

from torch import Tensor

from tests.exports import bare_flame
from tests.model.released_files import SMALL, SMALL_ESTIMATOR, randomize, released_shapes, write
from uika.head import HeadModel, surface_points, uv_texels

PREFIX = "renderer.flame_model."


def tables(head: HeadModel, size: int) -> dict[str, Tensor]:
    """What the release keeps of its head, for any head."""
    binding = uv_texels(head, size, "released")
    found = {
        "valid_mask_flatten": binding.valid.flatten(),
        "pix_to_v_idx_flatten": head.faces[binding.triangle],
        "pix_bary_flatten": binding.barycentric,
        "v_template_pix": surface_points(head.template, head.faces, binding),
        "v_template": head.template,
    }
    return {PREFIX + name: value for name, value in found.items()}


def released_tensors(head: HeadModel | None = None) -> dict[str, Tensor]:
    return randomize(released_shapes(SMALL, SMALL_ESTIMATOR)) | tables(head or bare_flame(), SMALL.map_size)


def write_released(folder: Path, name: str = "uika.safetensors", **changes: Tensor | None) -> Path:
    """The file; `changes` replace tensors, or take them away where None. Dots in names are written as `__`."""
    tensors = released_tensors()
    for key, value in changes.items():
        if value is None:
            del tensors[key.replace("__", ".")]
        else:
            tensors[key.replace("__", ".")] = value
    return write(folder, tensors, name)
