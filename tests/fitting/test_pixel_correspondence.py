"""Hair silhouettes and pixel-wise correspondence of fitted heads."""

import pytest
import torch
from torch import Tensor

from uika.fitting import Fit, pixel_uv
from uika.fitting.hair import MAX_OFFSET, fit_hair
from uika.fitting.long_hair import curtain
from uika.head import Camera, HeadModel, HeadParameters, load_head, look_at, project, rasterize
from uika.head import vertex_normals as normals_of

SIZE = 256


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head().without_bust


def covered(head: HeadModel, vertices: Tensor, camera: Camera) -> Tensor:
    points, depth = project(vertices, camera)
    return rasterize(points, head.faces, camera.height, camera.width, depth=depth, cull="none")[0] >= 0


def fitted(head: HeadModel, camera: Camera, offset: Tensor | None = None) -> Fit:
    offset = torch.zeros_like(head.template) if offset is None else offset
    return Fit(HeadParameters.zeros(head, 1), Camera.stack([camera]), offset, torch.zeros(1))


@pytest.mark.parametrize("yaws", [[0.0], [30.0], [0.0, 12.0, -12.0]])
def test_hair_meets_the_matte_in_every_photo(head: HeadModel, yaws: list[float]) -> None:
    lift = 0.03 * head.masks["scalp"][:, None] * torch.nn.functional.normalize(head.template, dim=-1)
    truth = head.template + lift
    cameras = Camera.stack([look_at(yaw, 0.0, 1.0, fov_y=22.0, size=SIZE) for yaw in yaws])
    mattes = torch.stack([covered(head, truth, cameras[n]) for n in range(len(yaws))])
    offset = fit_hair(head, HeadParameters.zeros(head, len(yaws)), cameras, mattes.float())
    for n in range(len(yaws)):
        got = covered(head, head.template + offset, cameras[n])
        bald = covered(head, head.template, cameras[n])
        overlap = (got & mattes[n]).sum() / (got | mattes[n]).sum()
        assert overlap > 0.95
        assert overlap > (bald & mattes[n]).sum() / (bald | mattes[n]).sum() + 0.03


def test_the_most_frontal_photo_counts(head: HeadModel) -> None:
    out = head.masks["scalp"][:, None] * torch.nn.functional.normalize(head.template, dim=-1)
    cameras = Camera.stack([look_at(yaw, 0.0, 1.0, fov_y=22.0, size=SIZE) for yaw in (0.0, 60.0)])
    # As if the second camera were wrong: a head that is larger there.
    mattes = torch.stack([covered(head, head.template + lift * out, cameras[n]) for n, lift in enumerate((0.02, 0.05))])
    both = fit_hair(head, HeadParameters.zeros(head, 2), cameras, mattes.float())
    alone = fit_hair(head, HeadParameters.zeros(head, 1), cameras[:1], mattes[:1].float())
    assert (both - alone).norm(dim=-1).max() < 0.002


def test_a_profile_alone_is_believed(head: HeadModel) -> None:
    camera = Camera.stack([look_at(90.0, 0.0, 1.0, fov_y=22.0, size=SIZE)])
    out = head.masks["scalp"][:, None] * torch.nn.functional.normalize(head.template, dim=-1)
    matte = covered(head, head.template + 0.03 * out, camera[0])[None].float()
    offset = fit_hair(head, HeadParameters.zeros(head, 1), camera, matte)
    assert offset.isfinite().all()
    assert offset.norm(dim=-1).max() > 0.02


def test_hair_leaves_the_face_alone_and_stays_bounded(head: HeadModel) -> None:
    camera = look_at(0.0, 0.0, 1.0, fov_y=30.0, size=SIZE)
    everything = torch.ones(1, SIZE, SIZE)
    everything[:, :8] = everything[:, -8:] = 0.0
    everything[..., :8] = everything[..., -8:] = 0.0
    offset = fit_hair(head, HeadParameters.zeros(head, 1), Camera.stack([camera]), everything)
    assert offset.isfinite().all()
    assert offset.norm(dim=-1).max() <= MAX_OFFSET + 1e-6
    assert offset[head.masks["face"] > 0.99].abs().max() == 0.0


def test_a_bald_matte_asks_for_no_hair(head: HeadModel) -> None:
    camera = Camera.stack([look_at(0.0, 0.0, 1.0, fov_y=22.0, size=SIZE)])
    matte = covered(head, head.template, camera[0])[None].float()
    assert fit_hair(head, HeadParameters.zeros(head, 1), camera, matte).norm(dim=-1).max() < 0.006


def test_a_matte_cut_at_the_jaw_leaves_the_neck(head: HeadModel) -> None:
    camera = Camera.stack([look_at(20.0, 0.0, 1.0, fov_y=22.0, size=SIZE)])
    neck = head.masks["neck"] > 0.99
    above = head.faces[~neck[head.faces].any(-1)]
    points, depth = project(head.template, camera[0])
    matte = rasterize(points, above, SIZE, SIZE, depth=depth, cull="none")[0] >= 0
    assert (covered(head, head.template, camera[0]) & ~matte).sum() > 500
    offset = fit_hair(head, HeadParameters.zeros(head, 1), camera, matte[None].float())
    assert offset[neck].norm(dim=-1).max() < 0.003


@pytest.mark.parametrize("yaw", [0.0, 35.0])
def test_hair_that_hangs_is_let_down(head: HeadModel, yaw: float) -> None:
    camera = look_at(yaw, 0.0, 1.0, fov_y=26.0, size=SIZE)
    lift = 0.01 * head.masks["scalp"][:, None] * torch.nn.functional.normalize(head.template, dim=-1)
    truth = head.template + curtain(head, head.template, -0.15) + lift
    offset = fit_hair(
        head, HeadParameters.zeros(head, 1), Camera.stack([camera]), covered(head, truth, camera)[None].float()
    )
    assert -0.18 < float(offset[:, 1].min()) < -0.12
    unseen = look_at(100.0, 0.0, 1.0, fov_y=26.0, size=SIZE)
    got, wanted = (covered(head, vertices, unseen) for vertices in (head.template + offset, truth))
    assert (got & wanted).sum() / (got | wanted).sum() > 0.9


@pytest.mark.parametrize("lift", [0.0, 0.02, 0.045])
def test_short_and_curly_hair_does_not_hang(head: HeadModel, lift: float) -> None:
    grown = head.template + lift * head.masks["scalp"][:, None] * normals_of(head.template, head.faces)
    cameras = Camera.stack([look_at(yaw, 0.0, 1.0, fov_y=26.0, size=SIZE) for yaw in (0.0, 40.0)])
    mattes = torch.stack([covered(head, grown, cameras[n]) for n in range(2)])
    offset = fit_hair(head, HeadParameters.zeros(head, 2), cameras, mattes.float())
    assert float(offset[:, 1].min()) > -0.06


def test_covered_ears_do_not_crumple(head: HeadModel) -> None:
    camera = Camera.stack([look_at(0.0, 0.0, 1.0, fov_y=26.0, size=SIZE)])
    grown = head.template + 0.04 * head.masks["scalp"][:, None] * normals_of(head.template, head.faces)
    matte = covered(head, grown, camera[0])[None].float()
    offset = fit_hair(head, HeadParameters.zeros(head, 1), camera, matte)
    eyes = head.joints[3:5].mean(0)
    x, y, z = (head.template - eyes).unbind(-1)
    # The bowls of the ears fold most.
    bowl = (x.abs() > 0.06) & ((y + 0.022).abs() < 0.016) & ((z + 0.077).abs() < 0.016)
    assert bowl.sum() > 100
    corners = head.faces[bowl[head.faces].all(-1)]
    bent, flat = (_bending(vertices, corners) for vertices in (head.template, head.template + offset))
    assert flat < 1.2 * bent
    assert offset[head.masks["eyeballs"] > 0.5].abs().max() == 0.0


def _bending(vertices: Tensor, corners: Tensor) -> float:
    """Mean angle in radians between neighbouring triangles' vertex normals and their faces' normals."""
    a, b, c = vertices[corners].unbind(1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    smooth = torch.zeros_like(vertices).index_add(0, corners.flatten(), normal.repeat_interleave(3, 0))
    smooth = torch.nn.functional.normalize(smooth, dim=-1)
    return float((smooth[corners] * normal[:, None]).sum(-1).clamp(-1, 1).acos().mean())


def test_pixel_uv_is_the_uv_of_the_surface_point(head: HeadModel) -> None:
    camera = look_at(20.0, 5.0, 1.0, fov_y=22.0, size=SIZE)
    uv, valid, weight = pixel_uv(fitted(head, camera), head, torch.ones(1, SIZE, SIZE))
    assert valid[0].float().mean() > 0.15
    assert ((weight > 0) == valid).all()
    assert float(uv.min()) >= 0 and float(uv.max()) <= 1
    # Face vertices that look at the camera: the pixel under each shows almost its own UV.
    normals = torch.nn.functional.normalize(normals_of(head.template, head.faces), dim=-1)
    facing = (normals * torch.nn.functional.normalize(camera.position - head.template, dim=-1)).sum(-1) > 0.8
    chosen = torch.nonzero(facing & (head.masks["face"] > 0.9) & (head.masks["eyes"] < 0.1)).flatten()
    vertex_uv = torch.zeros(len(head.template), 2)
    vertex_uv[head.faces.flatten()] = head.uvs[head.uv_faces.flatten()]
    column, row = project(head.template[chosen], camera)[0].long().T
    expected = torch.stack((vertex_uv[chosen, 0], 1 - vertex_uv[chosen, 1]), -1)
    error = (uv[0, row, column] - expected).norm(dim=-1)
    assert error.median() < 0.006


def test_background_and_hidden_pixels_carry_no_weight(head: HeadModel) -> None:
    camera = look_at(0.0, 0.0, 1.0, fov_y=22.0, size=SIZE)
    matte = torch.zeros(1, SIZE, SIZE)
    matte[:, : SIZE // 2] = 1.0
    uv, valid, weight = pixel_uv(fitted(head, camera), head, matte)
    assert not valid[0, SIZE // 2 :].any()
    assert weight[0, SIZE // 2 :].max() == 0
    assert (uv[0, SIZE // 2 :] == 0).all()


def test_mattes_of_another_size_are_refused(head: HeadModel) -> None:
    camera = look_at(0.0, 0.0, 1.0, size=SIZE)
    with pytest.raises(ValueError, match="mattes"):
        pixel_uv(fitted(head, camera), head, torch.ones(1, SIZE, SIZE // 2))


def test_hair_that_the_photo_cuts_goes_on_beyond_it(head: HeadModel) -> None:
    camera = look_at(0.0, 0.0, 1.0, fov_y=24.0, size=SIZE)
    grown = head.template + 0.03 * head.masks["scalp"][:, None] * normals_of(head.template, head.faces)
    matte = covered(head, grown, camera).float()
    edge = int((matte > 0.5).any(1).nonzero()[0]) + 22
    cut = matte.clone()
    cut[:edge] = 0.0
    bounds = torch.tensor([[0.0, float(edge), float(SIZE), float(SIZE)]])
    where = HeadParameters.zeros(head, 1), Camera.stack([camera])
    tops = []
    for given, edges in ((matte, None), (cut, bounds), (cut, None)):
        offset = fit_hair(head, *where, given[None], edges)
        tops.append(float((head.template + offset)[:, 1].max()))
    assert abs(tops[1] - tops[0]) < 0.008
    assert tops[2] < tops[0] - 0.012  # without knowing of the edge, the skull is pressed flat


def test_hair_hangs_on_the_side_where_the_photo_shows_it(head: HeadModel) -> None:
    camera = look_at(0.0, 0.0, 1.0, fov_y=26.0, size=SIZE)
    lift = 0.01 * head.masks["scalp"][:, None] * torch.nn.functional.normalize(head.template, dim=-1)
    left = (head.template[:, :1] > 0.0).float()
    truth = head.template + left * curtain(head, head.template, -0.15) + lift
    offset = fit_hair(
        head, HeadParameters.zeros(head, 1), Camera.stack([camera]), covered(head, truth, camera)[None].float()
    )
    aside = head.template[:, 0].abs() > 0.06
    low = [float(offset[aside & (sign * head.template[:, 0] > 0), 1].min()) for sign in (1, -1)]
    assert low[0] < -0.08 and low[1] > -0.05


def test_what_no_photo_shows_is_no_thicker_than_the_sides(head: HeadModel) -> None:
    camera = look_at(0.0, 0.0, 1.0, fov_y=26.0, size=SIZE)
    bun = ((head.template[:, 1] - 0.06) / 0.06).clamp(0, 1) * head.masks["scalp"]
    grown = head.template + (0.005 + 0.05 * bun)[:, None] * torch.nn.functional.normalize(head.template, dim=-1)
    offset = fit_hair(
        head, HeadParameters.zeros(head, 1), Camera.stack([camera]), covered(head, grown, camera)[None].float()
    )
    back = (head.template[:, 2] < -0.11) & (head.template[:, 1] > 0.0) & (head.template[:, 1] < 0.06)
    assert offset[back].norm(dim=-1).mean() < 0.02
