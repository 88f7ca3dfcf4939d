"""Small avatars for tests and benchmarks: the surface of a head with colours."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from uika import Avatar, HeadModel
from uika.canonical.surface import SurfaceTexels, closing_splats, surface_texels
from uika.head import Binding, uv_texels


def surface_avatar(
    head: HeadModel,
    size: int,
    colors: Callable[[SurfaceTexels, Binding], Tensor],
    static_offset: Tensor | None = None,
    opacity: float = 0.95,
    **provenance: str,
) -> Avatar:
    """The mean head as splats, one for each texel [M] of an atlas of side `size`; `colors` gives theirs, [M,3]."""
    identity = torch.zeros(len(head.identity_basis))
    offset = torch.zeros_like(head.template) if static_offset is None else static_offset
    surface, binding = surface_texels(head, identity, offset, size)
    return Avatar(
        head_id=head.id,
        identity=identity,
        static_offset=offset,
        means=surface.points[0],
        quats=surface.quats[0],
        scales=surface.scales[0],
        opacities=torch.full((len(binding),), opacity),
        colors=colors(surface, binding),
        triangle=binding.triangle,
        barycentric=binding.barycentric,
        provenance=provenance,
    )


def painted_avatar(head: HeadModel, size: int = 64) -> Avatar:
    """Red on the subject's left half, blue on the right, on the neutral head."""

    def halves(surface: SurfaceTexels, _: Binding) -> Tensor:
        left = (surface.points[0, :, :1] > 0).float()
        return left * torch.tensor([0.9, 0.1, 0.1]) + (1 - left) * torch.tensor([0.1, 0.1, 0.9])

    return surface_avatar(head, size, halves, photos="none", note="ünïcode")


def painted_bust(head: HeadModel, size: int = 64) -> Avatar:
    """The painted head on a grey bust."""
    avatar = painted_avatar(head, size)
    assert head.bust is not None
    binding = uv_texels(head, 3 * size // 4, tile=1)
    means, quats, scales = closing_splats(head, head.template, binding)
    return replace(
        avatar,
        bust_triangle=head.bust.face,
        means=torch.cat((avatar.means, means)),
        quats=torch.cat((avatar.quats, quats)),
        scales=torch.cat((avatar.scales, scales)),
        opacities=torch.cat((avatar.opacities, torch.full((len(binding),), 0.9))),
        colors=torch.cat((avatar.colors, torch.full((len(binding), 3), 0.3))),
        triangle=torch.cat((avatar.triangle, binding.triangle)),
        barycentric=torch.cat((avatar.barycentric, binding.barycentric)),
    )
