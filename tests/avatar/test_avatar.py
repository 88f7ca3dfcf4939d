from dataclasses import fields, replace

import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.avatars import painted_avatar
from tests.heads import sphere_head
from uika import Avatar, AvatarError, HeadModel, HeadParameters, load_head
from uika.avatar.avatar import FORMAT, VERSION
from uika.canonical.prior import prior_colors
from uika.canonical.surface import mirror_map, surface_texels
from uika.head import uv_texels


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return sphere_head()


@pytest.fixture(scope="module")
def avatar(head: HeadModel) -> Avatar:
    return painted_avatar(head)


def test_file_round_trip_is_exact(avatar, tmp_path):
    path = tmp_path / "new" / "a.safetensors"
    avatar.save(path)
    back = Avatar.load(path)
    assert back.head_id == avatar.head_id and back.provenance == avatar.provenance
    for field in fields(Avatar):
        value = getattr(avatar, field.name)
        if isinstance(value, torch.Tensor):
            assert torch.equal(getattr(back, field.name), value), field.name
    assert [entry.name for entry in path.parent.iterdir()] == ["a.safetensors"]


@pytest.mark.parametrize("kept", [0, 4, 100, 5000, -1])
def test_truncated_file_is_refused(avatar, tmp_path, kept):
    path = tmp_path / "cut.safetensors"
    avatar.save(path)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(AvatarError, match=r"cut\.safetensors: ") as caught:
        Avatar.load(path)
    assert "\n" not in str(caught.value)


def _rewrite(path, tensors=None, **metadata):
    kept = load_file(path)
    kept.update(tensors or {})
    header = {"format": FORMAT, "version": VERSION, "head_id": "synthetic-1", "provenance": "{}", **metadata}
    save_file({k: v for k, v in kept.items() if v is not None}, path, {k: v for k, v in header.items() if v})


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"version": "99"}, "version 99"),
        ({"format": "uika-model"}, "not an avatar file"),
        ({"format": ""}, "not an avatar file"),
        ({"head_id": ""}, "header"),
        ({"provenance": "{"}, "header"),
        ({"provenance": "[1]"}, "provenance"),
        ({"tensors": {"colors": None}}, "colors"),
        ({"tensors": {"extra": torch.zeros(1)}}, "extra"),
        ({"tensors": {"quats": torch.zeros(7, 4)}}, "quats"),
        ({"tensors": {"triangle": torch.zeros(3)}}, "triangle"),
    ],
)
def test_foreign_content_is_refused(avatar, tmp_path, changes, says):
    path = tmp_path / "odd.safetensors"
    avatar.save(path)
    _rewrite(path, **changes)
    with pytest.raises(AvatarError, match=r"odd\.safetensors: ") as caught:
        Avatar.load(path)
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value"), [("means", torch.nan), ("scales", -1.0), ("opacities", 1.5), ("colors", torch.inf)]
)
def test_impossible_values_are_refused(avatar, name, value):
    changed = getattr(avatar, name).clone()
    changed[5] = value
    with pytest.raises(AvatarError, match=name):
        replace(avatar, **{name: changed})


def test_missing_file_and_directory_are_refused(tmp_path):
    with pytest.raises(AvatarError, match="no such avatar file"):
        Avatar.load(tmp_path / "none.safetensors")
    with pytest.raises(AvatarError, match="directory"):
        Avatar.load(tmp_path)


def test_another_head_is_refused(avatar, head):
    rest = HeadParameters.zeros(head)
    with pytest.raises(AvatarError, match=r"'synthetic-1'.*'other'"):
        avatar.pose(rest, replace(head, id="other"))
    with pytest.raises(AvatarError, match="vertices"):
        avatar.check_head(sphere_head(rows=10))


def test_rest_pose_leaves_the_gaussians(avatar, head):
    means, quats, scales = avatar.pose(HeadParameters.zeros(head), head)
    torch.testing.assert_close(means, avatar.means, atol=1e-6, rtol=0)
    torch.testing.assert_close((quats * avatar.quats).sum(-1).abs(), torch.ones(len(avatar)), atol=1e-5, rtol=0)
    torch.testing.assert_close(scales, avatar.scales, atol=1e-6, rtol=1e-3)


def test_pose_keeps_the_avatars_identity_and_takes_batches(avatar, head):
    generator = torch.Generator().manual_seed(1)
    params = HeadParameters.zeros(head, 2).replace(
        expression=torch.rand(2, 3, generator=generator), rotation=torch.randn(2, 3, generator=generator)
    )
    batch = avatar.pose(params.replace(identity=torch.ones(2, 4)), head)
    for one, both in zip(avatar.pose(params[1], head), batch, strict=True):
        torch.testing.assert_close(both[1], one)


def test_jaw_moves_the_chin_and_nothing_above_the_nose():
    head = load_head()
    avatar = painted_avatar(head, 96)
    rest = HeadParameters.zeros(head)
    opened = rest.expression.clone()
    opened[head.expression_names.index("jawOpen")] = 1.0
    means, _, _ = avatar.pose(rest.replace(expression=opened), head)
    drop = avatar.means[:, 1] - means[:, 1]
    front = avatar.means[:, 2] > 0.03
    chin = front & (avatar.means[:, 1] < -0.085) & (avatar.means[:, 0].abs() < 0.02)
    brow = front & (avatar.means[:, 1] > 0.03)
    assert drop[chin].median() > 0.015
    assert drop[brow].abs().max() < 1e-3


def test_surface_splats_lie_flat_and_overlap_their_neighbours():
    head = load_head()
    size = 128
    surface, binding = surface_texels(
        head, torch.zeros(len(head.identity_basis)), torch.zeros_like(head.template), size
    )
    w, x, y, z = surface.quats[0].unbind(-1)
    normal = torch.stack((2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)), -1)
    corners = head.template[head.faces[binding.triangle]]
    outward = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cosine = torch.nn.functional.cosine_similarity(normal, outward, dim=-1)
    assert (cosine > 0.8).float().mean() > 0.95
    place = binding.to_map(surface.points[0], fill=torch.nan)
    steps = (place[:, :, 1:] - place[:, :, :-1]).norm(dim=0)
    reach = binding.to_map(surface.scales[0], fill=torch.nan)[0, :, :-1]
    known = torch.isfinite(steps) & torch.isfinite(reach)
    assert (steps[known] < 2.5 * reach[known]).float().mean() > 0.97


def test_mirror_map_joins_opposite_points():
    head = load_head()
    size = 128
    binding = uv_texels(head, size)
    mirror = mirror_map(head, size).flatten()[binding.texel]
    paired = mirror >= 0
    assert paired.float().mean() > 0.97
    points = (head.template[head.faces[binding.triangle]] * binding.barycentric[..., None]).sum(1)
    place = torch.full((size * size, 3), torch.nan)
    place[binding.texel] = points
    gap = place[mirror[paired]] * torch.tensor([-1.0, 1.0, 1.0]) - points[paired]
    assert gap.norm(dim=-1).median() < 1e-3
    assert gap.norm(dim=-1).max() < 0.02


def test_unseen_parts_take_the_colour_of_their_kind():
    head = load_head()
    size = 128
    binding = uv_texels(head, size)
    points = (head.template[head.faces[binding.triangle]] * binding.barycentric[..., None]).sum(1)
    skin, hair = torch.tensor([0.8, 0.6, 0.5]), torch.tensor([0.2, 0.15, 0.1])
    scalp = (head.masks["scalp"][head.faces[binding.triangle]] * binding.barycentric).sum(1) > 0.5
    color = torch.where(scalp[:, None], hair, skin)
    known = (points[:, 2] > 0.0)[:, None].float()
    offset = torch.zeros_like(head.template)
    supposed = binding.from_map(
        prior_colors(head, binding, offset, binding.to_map(color), binding.to_map(known)[0], brightness=1.0)
    )
    crown = (points[:, 2] < -0.11) & (points[:, 1] > 0.03)
    neck = (points[:, 2] < -0.02) & (points[:, 1] < -0.1)
    assert (supposed[crown & (points[:, 0].abs() < 0.04)] - hair).abs().max() < 0.2
    assert (supposed[neck].mean(0) - skin).abs().max() < 0.1
