"""What a made-up photo shows outside the surface becomes splats that stay where they belong."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from tests.avatars import painted_avatar, painted_bust
from uika import Avatar, HeadModel, load_head
from uika.avatar.framing import neutral_camera
from uika.avatar.rendering import render
from uika.fitting.torso import torso_parameters
from uika.head import HeadParameters, look_at, project, rasterize
from uika.head.bust import above_cut
from uika.photo_splats import PhotoView, with_photo_splats

SIZE = 256
GREEN = torch.tensor([0.1, 0.7, 0.2])


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head().without_bust


@pytest.fixture(scope="module")
def avatar(head: HeadModel) -> Avatar:
    return painted_avatar(head, 128)


def disc(column: float, row: float, radius: float) -> Tensor:
    at = torch.arange(SIZE) + 0.5
    return (((at[:, None] - row) ** 2 + (at - column) ** 2).sqrt() < radius).float()


def photo(avatar: Avatar, head: HeadModel, extra: Tensor, yaw: float = 0.0, *, clothes: bool = False) -> PhotoView:
    """The avatar as rendered, with something green behind it where `extra` [S,S] says so."""
    rest = HeadParameters.zeros(head).replace(identity=avatar.identity)
    camera = neutral_camera(avatar, yaw, 0.0, SIZE)
    shown = render(avatar, rest, camera, head)
    matte = torch.maximum(shown.alpha, extra)
    share = shown.alpha / matte.clamp_min(1e-6)
    color = share[..., None] * (shown.rgb - 1 + shown.alpha[..., None]) / shown.alpha[..., None].clamp_min(1e-6)
    color = color + (1 - share[..., None]) * GREEN
    image = matte[..., None] * color + 1 - matte[..., None]
    hair = shown.alpha if clothes else matte
    return PhotoView(rest, camera, image.permute(2, 0, 1).clamp(0, 1), matte, hair)


def top(avatar: Avatar, head: HeadModel) -> tuple[float, float]:
    """Pixel of the crown."""
    alpha = photo(avatar, head, torch.zeros(SIZE, SIZE)).matte
    row = int((alpha > 0.5).any(1).nonzero()[0])
    return float((alpha[row + 4] > 0.5).nonzero().float().mean()), row


def test_a_bun_is_reproduced_and_is_no_card(avatar: Avatar, head: HeadModel) -> None:
    column, row = top(avatar, head)
    view = photo(avatar, head, disc(column, row - 8, 18))
    result = with_photo_splats(avatar, head, [view])
    shown = render(result, view.parameters, view.camera, head)
    before, after = (
        ((1 - (alpha - view.matte).abs()) * view.matte).sum() / view.matte.sum()
        for alpha in (render(avatar, view.parameters, view.camera, head).alpha, shown.alpha)
    )
    assert before < 0.985 < after
    bun = disc(column, row - 12, 8) > 0
    assert (shown.rgb[bun] - GREEN).abs().mean() < 0.03
    added = result.means[len(avatar) :]
    added = added[added[:, 1] > avatar.means[:, 1].max() + 0.005]
    wide, _, deep = (added.quantile(0.95, 0) - added.quantile(0.05, 0)).tolist()
    assert deep > 0.6 * wide
    side = neutral_camera(avatar, 70.0, 0.0, SIZE)
    alone = replace(result, opacities=torch.where(torch.arange(len(result)) < len(avatar), 0.0, result.opacities))
    areas = [float(render(alone, view.parameters, camera, head).alpha.sum()) for camera in (view.camera, side)]
    assert areas[1] > 0.6 * areas[0]


def test_holes_stay_holes(avatar: Avatar, head: HeadModel) -> None:
    column, row = top(avatar, head)
    hole = disc(column, row - 14, 5)
    view = photo(avatar, head, disc(column, row - 8, 18) * (1 - hole))
    result = with_photo_splats(avatar, head, [view])
    assert render(result, view.parameters, view.camera, head).alpha[disc(column, row - 14, 3) > 0].max() < 0.3


def test_nothing_beside_the_face(avatar: Avatar, head: HeadModel) -> None:
    view = photo(avatar, head, torch.zeros(SIZE, SIZE), yaw=55.0)
    wider = max_pool2d(view.matte[None, None], 9, 1, 4)[0, 0]
    result = with_photo_splats(avatar, head, [replace(view, matte=wider, hair=wider)])
    vertices = avatar.canonical_vertices(head)
    pixels, depth = project(vertices, view.camera)
    triangle, mix = rasterize(pixels, head.faces, SIZE, SIZE, depth=depth)
    skin = ((head.masks["face"][head.faces[triangle.clamp_min(0)]] * mix).sum(-1) > 0.9) & (triangle >= 0)
    around = max_pool2d(skin.float()[None, None], 5, 1, 2)[0, 0] > 0
    places = project(result.means[len(avatar) :], view.camera)[0].long()
    assert len(places) > 200
    assert not bool(around[places[:, 1].clamp(0, SIZE - 1), places[:, 0].clamp(0, SIZE - 1)].any())


def test_another_photo_carves_what_it_shows_as_background(avatar: Avatar, head: HeadModel) -> None:
    column, row = top(avatar, head)
    view = photo(avatar, head, disc(column, row - 8, 18))
    alone = len(with_photo_splats(avatar, head, [view])) - len(avatar)
    other = photo(avatar, head, torch.zeros(SIZE, SIZE), yaw=40.0)
    both = with_photo_splats(avatar, head, [view, other])
    high = both.means[len(avatar) :, 1] > avatar.means[:, 1].max() + 0.008
    assert int(high.sum()) < 0.1 * alone


def test_the_limit_holds_and_nothing_is_added_where_nothing_lacks(avatar: Avatar, head: HeadModel) -> None:
    column, row = top(avatar, head)
    view = photo(avatar, head, disc(column, row - 8, 40))
    few = with_photo_splats(avatar, head, [view], limit=800)
    assert 200 < len(few) - len(avatar) <= 800
    bald = replace(view, matte=torch.zeros(SIZE, SIZE), hair=torch.zeros(SIZE, SIZE))
    assert with_photo_splats(avatar, head, [bald]) is avatar


def test_hair_follows_the_scalp_and_clothes_do_not_follow_the_jaw(avatar: Avatar, head: HeadModel) -> None:
    column, row = top(avatar, head)
    hair = photo(avatar, head, disc(column, row - 8, 18))
    low = (torch.arange(SIZE) > SIZE - 24).float()[:, None].expand(SIZE, SIZE)
    clothes = photo(avatar, head, low, clothes=True)
    still = HeadParameters.zeros(head).replace(identity=avatar.identity)
    turned, open_ = still.replace(neck=torch.tensor([0.0, 0.5, 0.0])), still.replace(jaw=torch.tensor([0.3, 0.0, 0.0]))
    for view, moved, share in ((hair, turned, 1.0), (clothes, open_, 0.0)):
        result = with_photo_splats(avatar, head, [view])
        way = result.pose(moved, head)[0] - result.pose(still, head)[0]
        far = (way[len(avatar) :].norm(dim=-1) > 0.005).float().mean()
        assert abs(far - share) < 0.25  # the neck's own edge moves with the jaw


def test_photos_agree_on_how_wide_hair_is(avatar: Avatar, head: HeadModel) -> None:
    avatar = replace(avatar, colors=torch.tensor([0.8, 0.6, 0.5]).expand(len(avatar), 3))
    crown = float(avatar.means[:, 1].max())
    before = float(avatar.means[(avatar.means[:, 1] - crown + 0.02).abs() < 0.003, 2].max())
    middle = torch.tensor([0.0, crown - 0.02, before + 0.012])
    lock = middle + torch.cartesian_prod(*(torch.arange(-half, half, 0.003) for half in (0.045, 0.015, 0.015)))
    truth = grown(avatar, head, lock)
    rest = HeadParameters.zeros(head).replace(identity=avatar.identity)

    def view(yaw: float) -> PhotoView:
        camera = neutral_camera(avatar, yaw, 0.0, SIZE)
        shown = render(truth, rest, camera, head)
        return PhotoView(rest, camera, shown.rgb.permute(2, 0, 1).clamp(0, 1), shown.alpha, shown.alpha)

    held = neutral_camera(avatar, -35.0, 0.0, SIZE)
    there = render(truth, rest, held, head).alpha - render(avatar, rest, held, head).alpha > 0.5
    result = with_photo_splats(avatar, head, [view(80.0), view(15.0)])
    shown = render(result, rest, held, head)
    assert int(there.sum()) > 200
    assert shown.alpha[there].mean() > 0.95
    assert (shown.rgb[there] - GREEN).abs().mean() < 0.05


def grown(avatar: Avatar, head: HeadModel, points: Tensor) -> Avatar:
    """The avatar with small green splats at points [M,3]."""
    count = len(points)
    scalp = int((head.masks["scalp"][head.faces].sum(-1)).argmax())
    return replace(
        avatar,
        means=torch.cat((avatar.means, points)),
        quats=torch.cat((avatar.quats, torch.eye(4)[:1].expand(count, 4))),
        scales=torch.cat((avatar.scales, torch.full((count, 3), 0.002))),
        opacities=torch.cat((avatar.opacities, torch.full((count,), 0.95))),
        colors=torch.cat((avatar.colors, GREEN.expand(count, 3))),
        triangle=torch.cat((avatar.triangle, torch.full((count,), scalp))),
        barycentric=torch.cat((avatar.barycentric, torch.full((count, 3), 1 / 3))),
    )


def test_a_wider_crop_adds_clothes_to_the_turned_torso() -> None:
    whole = load_head()
    assert whole.bust is not None
    avatar = painted_bust(whole, 96)
    pose = torso_parameters(whole, HeadParameters.zeros(whole), torch.tensor([0.0, 0.5, 0.1]))
    camera = look_at(0.0, 0.0, 1.6, target=(0.0, -0.1, 0.0), fov_y=26.0, size=SIZE)
    near = look_at(0.0, 0.0, 1.6, target=(0.0, 0.0, 0.0), fov_y=13.0, size=SIZE)
    shown = render(avatar, pose, camera, whole)
    row = int((shown.alpha[:, 60] > 0.5).nonzero()[0])
    matte = torch.maximum(shown.alpha, disc(60, row, 14))
    share = (shown.alpha / matte.clamp_min(1e-6))[..., None]
    image = share * shown.rgb + (1 - share) * GREEN
    image = matte[..., None] * image + 1 - matte[..., None]
    body = PhotoView(pose, camera, image.permute(2, 0, 1), matte, torch.zeros(SIZE, SIZE))
    close = render(avatar, pose, near, whole)
    view = PhotoView(pose, near, close.rgb.permute(2, 0, 1), close.alpha, close.alpha)
    result = with_photo_splats(avatar, whole, [view], body=body)
    assert len(result) - len(avatar) > 100
    green = (result.colors[len(avatar) :] - GREEN).norm(dim=-1) < 0.1
    assert int(green.sum()) > 100
    assert bool((result.triangle[len(avatar) :][green] >= whole.bust.face).all())
    again = render(result, pose, camera, whole)
    beyond = (disc(60, row, 12) > 0) & (shown.alpha < 0.05)
    assert int(beyond.sum()) > 50
    assert again.alpha[beyond].mean() > 0.9
    assert (again.rgb[beyond] - GREEN).abs().mean() < 0.08
    assert above_cut(whole.template, avatar.canonical_vertices(whole), result.means).min() > -1e-3


def test_what_hangs_together_with_nothing_is_left_out(avatar: Avatar, head: HeadModel) -> None:
    row = int(top(avatar, head)[1]) + 60
    edge = int((photo(avatar, head, torch.zeros(SIZE, SIZE)).matte[row] > 0.5).nonzero()[0])
    plain, joined, alone = (
        len(with_photo_splats(avatar, head, [photo(avatar, head, extra)]))
        for extra in (torch.zeros(SIZE, SIZE), disc(edge - 6, row, 14), disc(edge - 30, row, 14))
    )
    assert joined > plain + 100 and alone == plain
