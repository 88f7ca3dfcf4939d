"""Small avatars for tests: the surface of a head with colours painted by position."""

import torch

from uika import Avatar, HeadModel
from uika.canonical.surface import surface_texels


def painted_avatar(head: HeadModel, size: int = 64) -> Avatar:
    """Red on the subject's left half, blue on the right, on the neutral head."""
    identity, offset = torch.zeros(len(head.identity_basis)), torch.zeros_like(head.template)
    surface, binding = surface_texels(head, identity, offset, size)
    left = (surface.points[0, :, :1] > 0).float()
    return Avatar(
        head_id=head.id,
        identity=identity,
        static_offset=offset,
        means=surface.points[0],
        quats=surface.quats[0],
        scales=surface.scales[0],
        opacities=torch.full((len(binding),), 0.95),
        colors=left * torch.tensor([0.9, 0.1, 0.1]) + (1 - left) * torch.tensor([0.1, 0.1, 0.9]),
        triangle=binding.triangle,
        barycentric=binding.barycentric,
        provenance={"photos": "none", "note": "ünïcode"},
    )
