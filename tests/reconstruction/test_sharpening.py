"""Colours that make the picture as sharp as the photo."""

from dataclasses import replace

import torch

from tests.avatars import painted_avatar
from uika import load_head, neutral_camera
from uika.avatar.rendering import render
from uika.head import HeadParameters
from uika.reconstruction.sharpening import sharpened


def test_a_step_brings_the_picture_nearer_and_leaves_the_hidden_alone() -> None:
    head = load_head().without_bust
    avatar, rest = painted_avatar(head, 96), HeadParameters.zeros(head)
    camera = neutral_camera(avatar, 0.0, 0.0, 192)
    noise = 0.3 * torch.randn(avatar.colors.shape, generator=torch.Generator().manual_seed(0))
    image = render(replace(avatar, colors=(avatar.colors + noise).clamp(0, 1)), rest, camera, head)
    known = (image.alpha > 0.9).float()
    photo, every = image.rgb.permute(2, 0, 1), torch.ones(len(avatar), dtype=torch.bool)
    errors = []
    result = avatar
    for _ in range(2):
        shown = render(result, rest, camera, head).rgb
        errors.append(float((shown - image.rgb).square().mean(-1)[known > 0].mean()))
        result = sharpened(result, head, rest, camera, photo, known, every, relit=False)
    assert errors[1] < 0.5 * errors[0]
    back = avatar.means[:, 2] < -0.12
    assert torch.equal(result.colors[back], avatar.colors[back])
    darker = sharpened(avatar, head, rest, camera, 0.8 * photo, known, every, relit=True)
    assert (darker.colors - avatar.colors).mean().abs() < 0.01  # another light is no other colour
    none = sharpened(avatar, head, rest, camera, photo, known, ~every, relit=False)
    assert torch.equal(none.colors, avatar.colors)
