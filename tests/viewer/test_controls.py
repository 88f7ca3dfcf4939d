import math

import numpy as np
import pytest
import torch

from tests.avatars import painted_avatar
from tests.heads import sphere_head
from uika import Avatar, HeadModel, load_head, neutral_camera
from uika.head import HeadParameters
from uika.viewer.controls import Controls, action_groups
from uika.viewer.live import UNITS, LiveSplats
from uika.viewer.still import camera_of


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


def test_every_action_is_in_one_group(head):
    groups = action_groups(head)
    assert sorted(name for names in groups.values() for name in names) == sorted(head.expression_names)
    assert list(groups) == ["Brows", "Eyes", "Jaw and tongue", "Mouth", "Cheeks and nose"]
    assert list(action_groups(sphere_head())) == ["Expression"]


def test_sliders_mean_what_they_say(head):
    params = Controls(turn=30.0, jaw=0.5, gaze_down=10.0, actions={"browInnerUp": 0.7, "jawOpen": 0.2}).parameters(head)
    named = dict(zip(head.expression_names, params.expression.tolist(), strict=True))
    assert named["jawOpen"] == 0.5 and named["browInnerUp"] == pytest.approx(0.7) and sum(named.values()) < 1.21
    assert params.neck.tolist() == pytest.approx([0, math.radians(30), 0])
    assert params.eyes.tolist() == pytest.approx([math.radians(10), 0, 0] * 2)
    small = Controls(jaw=1.0).parameters(sphere_head())
    assert small.jaw[0] > 0.2 and small.expression.abs().sum() == 0


def test_buffer_holds_the_posed_gaussians(head):
    avatar = painted_avatar(head, 64)
    params = Controls(turn=40.0, jaw=0.8).parameters(head)
    live = LiveSplats(avatar, head)
    buffer, vertices = live.pose(params)
    means, quats, scales = avatar.pose(params, head)
    assert np.allclose(buffer[:, :3].view(np.float32), means.numpy() * UNITS, atol=2e-3)
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    turn = torch.stack(
        (
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ),
        -1,
    ).unflatten(-1, (3, 3))
    truth = (turn * (scales * UNITS)[:, None].square()) @ turn.mT
    found = torch.from_numpy(buffer[:, 4:7].copy().view(np.float16).astype(np.float32))
    upper = truth[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    assert (found - upper).abs().max() < 2e-3 * truth.amax()
    rgba = buffer[:, 7:8].copy().view(np.uint8)
    assert rgba[:, 3].tolist() == [242] * len(avatar)
    assert np.abs(rgba[:, :3] / 255 - avatar.colors.numpy()).max() < 0.003
    assert vertices.shape == (len(head.template), 3) and np.isfinite(vertices).all()
    live.paint("UV")
    assert live.pose(params)[0][:, 7].tolist() != buffer[:, 7].tolist()


def test_another_identity_moves_the_gaussians_with_the_surface(head):
    avatar = painted_avatar(head, 48)
    live = LiveSplats(avatar, head)
    identity = avatar.identity.clone()
    identity[0] = 2.0
    live.reshape(identity)
    assert torch.equal(live.avatar.identity, identity)

    def height(one: Avatar) -> torch.Tensor:
        corners = one.canonical_vertices(head)[head.faces[one.triangle]]
        return (one.means - (corners * one.barycentric[..., None]).sum(1)).norm(dim=-1)

    assert torch.allclose(height(live.avatar), height(avatar), atol=1e-5)
    assert (live.avatar.means - avatar.means).norm(dim=-1).max() > 1e-3
    live.reshape(avatar.identity)
    assert torch.allclose(live.avatar.means, avatar.means, atol=1e-6)
    assert live.pose(HeadParameters.zeros(head))[0].shape == (len(avatar), 8)


def test_browser_camera_is_understood(head):
    truth = neutral_camera(painted_avatar(head, 32), 0.0, 0.0, 200)
    view = ((0.0, 1.0, 0.0, 0.0), (truth.position * UNITS).numpy(), math.radians(20.0))
    found = camera_of(view, 200, 200)
    assert torch.allclose(found.viewmat, truth.viewmat, atol=1e-5) and torch.allclose(found.K, truth.K, rtol=1e-5)
