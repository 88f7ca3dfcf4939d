import numpy as np
import pytest
import torch

from uika import Avatar, HeadModel, frames, get_motion, neutral_camera
from uika.avatar import AvatarError
from uika.avatar.frame_renderer import film
from uika.head import load_head
from uika.io.video import to_bytes
from uika.motion import Motion

SIZE = 96


def _moving(head: HeadModel, count: int) -> Motion:
    phase = torch.arange(count, dtype=torch.float32)[:, None] / 5
    still = torch.zeros(count, 3)
    return Motion(
        expression=phase.sin().expand(-1, len(head.expression_names)),
        rotation=torch.cat((0.1 * phase, 0.5 * phase.sin(), 0 * phase), 1),
        neck=0.2 * phase.cos().expand(-1, 3),
        jaw=still,
        eyes=torch.zeros(count, 6),
        translation=still,
        fps=25.0,
        yaw=20 * phase[:, 0],
    )


def test_closed_pixels_are_off_by_a_level_at_most(head: HeadModel, avatar: Avatar) -> None:
    motion = _moving(head, 2)
    quick, whole = (list(film(avatar, motion, head=head, size=SIZE, closing=closing)) for closing in (None, 0))
    for one, other in zip(quick, whole, strict=True):
        assert np.abs(one.astype(int) - other).max() <= 1


def test_bytes_are_those_of_the_differentiable_way(head: HeadModel, avatar: Avatar) -> None:
    motion = _moving(head, 18)
    background = (0.2, 0.4, 0.6)
    pictures = list(film(avatar, motion, head=head, background=background, size=SIZE, closing=0, level="full"))
    assert len(pictures) == 18
    for picture, frame in zip(pictures, frames(avatar, motion, None, head, background, size=SIZE), strict=True):
        assert picture.shape == (SIZE, SIZE, 3) and picture.dtype == np.uint8
        difference = np.abs(picture.astype(int) - to_bytes(frame.rgb))
        assert difference.max() <= 1 and difference.mean() < 0.01
    assert np.abs(pictures[0].astype(int) - pictures[10]).max() > 50


def test_one_frame_and_a_fixed_oblong_camera(head: HeadModel, avatar: Avatar) -> None:
    camera = neutral_camera(avatar, 30.0, size=SIZE).resized(SIZE, 64)
    (picture,) = film(avatar, _moving(head, 1), camera, head)
    assert picture.shape == (64, SIZE, 3) and picture[0, 0].tolist() == [255, 255, 255]


def test_another_head_is_refused(avatar: Avatar) -> None:
    builtin = load_head()
    with pytest.raises(AvatarError, match="synthetic-1"):
        next(film(avatar, get_motion("orbit", builtin), head=builtin, size=SIZE))
