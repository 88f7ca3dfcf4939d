"""Whether a head model is the one that released weights were made for, and where on it their Gaussians sit."""

from __future__ import annotations

import torch
from torch import Tensor

from uika.head import Binding, HeadModel, surface_points, uv_texels
from uika.model.checkpoint import CheckpointError
from uika.model.released import ReleasedModel

_SAME = 1e-4  # metres; templates of two versions of FLAME lie millimetres apart
_ADVICE = "import the FLAME 2023 (with jaw) that they were trained with: uika head import MODEL.pkl --obj MESH.obj"


def template_binding(model: ReleasedModel, head: HeadModel, name: str) -> Binding:
    """The triangles of a head model that carry the model's Gaussians, in the model's order.

    The file's own table of corners decides where it has one, else the head's atlas is covered by the same rule.

    Args:
        model: the released model.
        head: the head model that shall carry the avatar.
        name: of the weights' file, for messages.

    Raises:
        CheckpointError: the head has another mesh, atlas or mean face than the weights; the sentence says which.
    """
    size = model.network.config.map_size
    if model.corners is None or model.barycentric is None:
        binding = uv_texels(head, size, "released")
        if not torch.equal(binding.texel, model.texel):
            raise CheckpointError(
                f"{name}: its atlas has {len(model.texel):,} texels, that of the head model '{head.id}' "
                f"{len(binding):,} at the same size; {_ADVICE}"
            )
    else:
        triangle, barycentric = _on_mesh(head, model.corners, model.barycentric, name)
        binding = Binding(size, model.texel, triangle, barycentric)
        _check_atlas(head, binding, name)
    distance = (surface_points(head.template, head.faces, binding) - model.points).norm(dim=-1).max()
    if not float(distance) <= _SAME:
        raise CheckpointError(
            f"{name}: was trained on another mean head than '{head.id}', up to {1000 * float(distance):.1f} mm away "
            f"from it; {_ADVICE}"
        )
    return binding


def _on_mesh(head: HeadModel, corners: Tensor, barycentric: Tensor, name: str) -> tuple[Tensor, Tensor]:
    """Triangle [M] with the given corners [M,3], and barycentric coordinates [M,3] in its own order of them."""
    if int(corners.max()) >= len(head.template):
        raise CheckpointError(
            f"{name}: needs a head of more than {int(corners.max()):,} vertices, and '{head.id}' has "
            f"{len(head.template):,}; {_ADVICE}"
        )
    own, order = head.faces.sort(dim=1)
    wanted, place = corners.sort(dim=1)
    count = len(head.template)
    keys = (own * torch.tensor([count**2, count, 1])).sum(1)
    searched = (wanted * torch.tensor([count**2, count, 1])).sum(1)
    sorted_keys, row = keys.sort()
    at = torch.searchsorted(sorted_keys, searched).clamp(max=len(keys) - 1)
    found = sorted_keys[at] == searched
    if not bool(found.all()):
        missing = int((~found).sum())
        raise CheckpointError(
            f"{name}: {missing:,} of its {len(corners):,} Gaussians lie on triangles that the head model '{head.id}' "
            f"does not have; {_ADVICE}"
        )
    triangle = row[at]
    # Both orders of corners lead over the sorted one.
    return triangle, torch.zeros_like(barycentric).scatter(1, order[triangle], barycentric.gather(1, place))


def _check_atlas(head: HeadModel, binding: Binding, name: str) -> None:
    """The head's texture coordinates must lead to the texels of the file's tables."""
    corners = head.uvs[head.uv_faces[binding.triangle]]
    uv = (corners * binding.barycentric[..., None]).sum(1) * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1.0])
    away = ((uv - binding.uv).abs() * binding.size).amax(-1) > 1
    if bool(away.any()):
        raise CheckpointError(
            f"{name}: {int(away.sum()):,} of its {len(binding):,} texels lie elsewhere in the texture coordinates of "
            f"the head model '{head.id}'; {_ADVICE}"
        )
