"""Every format is read back and rendered again beside the avatar itself."""

import dataclasses
import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from drjit_splat import load_ply, load_spz, rasterization
from tests.avatars import painted_avatar, painted_bust
from tests.heads import sphere_head
from uika import Avatar, HeadModel, UikaError, get_motion, load_head, neutral_camera, render
from uika.export import (
    Splats,
    glb_provenance,
    posed_splats,
    read_glb,
    read_splat,
    thinned,
    write_bound_ply,
    write_glb,
    write_npz,
    write_ply,
    write_ply_sequence,
    write_splat,
    write_spz,
)
from uika.export.ply import triangle_frames
from uika.head import HeadParameters, pose_gaussians
from uika.metrics import psnr
from uika.motion import Motion

SIZE = 160


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return sphere_head()


@pytest.fixture(scope="module")
def avatar(head: HeadModel) -> Avatar:
    plain = painted_avatar(head, 64)
    g = torch.Generator().manual_seed(0)
    colors = (plain.colors + 0.2 * torch.rand(len(plain), 3, generator=g)).clamp(0, 1)
    return dataclasses.replace(
        plain, colors=colors, means=plain.means + 0.002 * torch.randn(len(plain), 3, generator=g)
    )


@pytest.fixture(scope="module")
def motion(head: HeadModel) -> Motion:
    motion = get_motion("orbit", head)
    turned = torch.linspace(0, 0.6, len(motion))[:, None] * torch.tensor([[0.3, 1.0, -0.2]])
    return dataclasses.replace(motion, rotation=turned, expression=motion.expression + 0.5)


def _picture(avatar: Avatar, splats: Splats) -> Tensor:
    camera = neutral_camera(avatar, 25.0, 10.0, SIZE)
    colors, _, _ = rasterization(
        *(splats.means, splats.quats, splats.scales, splats.opacities, splats.colors),
        camera.viewmat[None],
        camera.K[None],
        SIZE,
        SIZE,
        backgrounds=torch.ones(1, 3),
    )
    return colors[0]


def _from_ply(path: Path) -> Splats:
    file = load_spz(path) if path.suffix == ".spz" else load_ply(path)
    return Splats(file.means, file.quats, file.scales, file.opacities, file.colors)


@pytest.mark.parametrize(
    ("kind", "decibels", "largest"),
    [("ply", 90, 1e-4), ("splat", 45, 0.05), ("spz", 40, 0.1), ("glb", 90, 1e-4), ("npz", 90, 1e-4)],
)
def test_read_back_and_rendered_again(avatar, head, motion, tmp_path, kind, decibels, largest):
    params = motion.parameters(avatar.identity)[60]
    truth = render(avatar, params, neutral_camera(avatar, 25.0, 10.0, SIZE), head).rgb
    splats, path = posed_splats(avatar, head, params), tmp_path / f"new/a.{kind}"
    if kind == "ply":
        write_ply(path, splats.half_turned(), avatar.provenance)
        found = _from_ply(path).half_turned()
    elif kind == "splat":
        write_splat(path, splats.half_turned())
        found = read_splat(path).half_turned()
    elif kind == "spz":
        write_spz(path, splats)
        found = _from_ply(path).turned_over()
    elif kind == "glb":
        write_glb(path, splats, avatar.provenance)
        found = read_glb(path)
        assert glb_provenance(path) == avatar.provenance
    else:
        found = _from_npz(path, avatar, head, motion, 60)
    picture = _picture(avatar, found)
    measured, worst = psnr(picture, truth), (picture - truth).abs().max()
    print(f"{kind}: {path.stat().st_size} bytes, {measured:.1f} dB, largest difference {worst:.5f}")
    assert measured >= decibels and worst <= largest
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def _from_npz(path: Path, avatar: Avatar, head: HeadModel, motion: Motion, frame: int) -> Splats:
    write_npz(path, avatar, head, motion)
    with np.load(path, allow_pickle=False) as file:
        a = {name: file[name] for name in file.files}
    assert json.loads(str(a.pop("provenance"))) == avatar.provenance and a.pop("fps") == motion.fps
    t = {name: torch.from_numpy(value) for name, value in a.items()}
    binding = (t["faces"], t["triangle"], t["barycentric"])
    moved = pose_gaussians(t["means"], t["quats"], t["scales"], t["vertices"], t["frames"][frame], *binding)
    return Splats(*moved, t["opacities"], t["colors"])


def test_turned_files_are_upright_where_y_points_down(avatar, head, tmp_path):
    splats = posed_splats(avatar, head)
    down = splats.half_turned()
    top = splats.means[:, 1].argmax()
    assert down.means[top, 1] == -splats.means[top, 1] and torch.equal(down.means[:, 2], splats.means[:, 2])
    # The same picture from a camera that was turned with the file, and another one from where it was.
    camera = neutral_camera(avatar, 25.0, 10.0, SIZE)
    turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))
    arguments = (down.means, down.quats, down.scales, down.opacities, down.colors)
    K, white = camera.K[None], torch.ones(1, 3)
    seen, _, _ = rasterization(*arguments, (camera.viewmat @ turn)[None], K, SIZE, SIZE, backgrounds=white)
    assert psnr(seen[0], _picture(avatar, splats)) > 60
    assert psnr(_picture(avatar, down), _picture(avatar, splats)) < 30


def test_bound_ply_is_the_avatar_in_its_triangles(avatar, head, tmp_path):
    path = tmp_path / "a.ply"
    assert write_bound_ply(path, avatar, head) is None
    header, body = path.read_bytes().split(b"end_header\n")
    names = [line.split()[2] for line in header.splitlines() if line.startswith(b"property")]
    binding = np.frombuffer(body, "<f4").reshape(-1, len(names))[:, names.index(b"binding_0")]
    assert np.array_equal(binding, avatar.triangle.numpy())
    local = load_ply(path)
    centre, rotation, size = triangle_frames(avatar.canonical_vertices(head), head.faces)
    assert torch.allclose(torch.linalg.det(rotation.double()), torch.ones(len(size)).double(), atol=1e-5)
    turn, length = rotation[avatar.triangle], size[avatar.triangle][:, None]
    means = (turn @ (local.means * length)[..., None])[..., 0] + centre[avatar.triangle]
    assert torch.allclose(means, avatar.means, atol=1e-6)
    assert torch.allclose(local.scales * length, avatar.scales, rtol=1e-4)
    together = turn @ _matrix(local.quats)
    assert torch.allclose(together, _matrix(avatar.quats), atol=1e-4)
    flame = dataclasses.replace(head, id="flame-test")
    beside = write_bound_ply(path, dataclasses.replace(avatar, head_id="flame-test"), flame)
    assert beside == tmp_path / "flame_param.npz"
    with np.load(beside, allow_pickle=False) as file:
        assert file["shape"].shape == (300,) and file["expr"].shape == (1, 100)
        assert file["static_offset"].shape == (1, len(head.template), 3)


def _matrix(quats: Tensor) -> Tensor:
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y))
    rows += (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x))
    rows += (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def test_sequence_has_one_file_for_each_frame(avatar, head, motion, tmp_path):
    short = Motion(**{name: value[:3] for name, value in motion.tensors().items()}, fps=motion.fps)
    assert write_ply_sequence(tmp_path / "frames", avatar, short, head, y_down=False) == 3
    names = sorted(path.name for path in (tmp_path / "frames").iterdir())
    assert names == ["frame_00000.ply", "frame_00001.ply", "frame_00002.ply"]
    truth = posed_splats(avatar, head, short.parameters(avatar.identity)[2])
    assert torch.equal(_from_ply(tmp_path / "frames" / names[2]).means, truth.means)


def test_glb_follows_the_extension(avatar, head, tmp_path):
    path = tmp_path / "a.glb"
    write_glb(path, posed_splats(avatar, head), {"photos": "<ünïcode>"})
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<IIIII", data)
    assert (magic, version, length, kind) == (0x46546C67, 2, len(data), 0x4E4F534A) and size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"] and "extensionsRequired" not in document
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert extension == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    kinds = {name: document["accessors"][index]["type"] for name, index in primitive["attributes"].items()}
    assert kinds == {
        "POSITION": "VEC3",
        "KHR_gaussian_splatting:ROTATION": "VEC4",
        "KHR_gaussian_splatting:SCALE": "VEC3",
        "KHR_gaussian_splatting:OPACITY": "SCALAR",
        "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0": "VEC3",
        "COLOR_0": "VEC4",
    }
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    assert position["max"] == avatar.means.amax(0).tolist() and position["count"] == len(avatar)
    assert glb_provenance(path) == {"photos": "<ünïcode>"}


def test_damaged_files_are_named(avatar, head, tmp_path):
    write_glb(tmp_path / "a.glb", posed_splats(avatar, head))
    whole = (tmp_path / "a.glb").read_bytes()
    edits = {
        "cut short": whole[:-100],
        "no .glb": b"solid" + whole,
        "holds no Gaussians": whole.replace(b'"KHR_gaussian_splatting":{', b'"KHR_gaussian_splattinX":{'),
        "does not fit": whole.replace(b'"count":' + str(len(avatar)).encode(), b'"count":9999', 1),
        "not finite": whole[:-4000].replace(avatar.means.numpy().tobytes()[:4], b"\x00\x00\xc0\x7f", 1) + whole[-4000:],
    }
    for says, data in edits.items():
        (tmp_path / "b.glb").write_bytes(data)
        with pytest.raises(UikaError, match=rf"b\.glb: .*{says}"):
            read_glb(tmp_path / "b.glb")
    write_splat(tmp_path / "a.splat", posed_splats(avatar, head))
    (tmp_path / "b.splat").write_bytes((tmp_path / "a.splat").read_bytes()[:-3])
    with pytest.raises(UikaError, match=r"b\.splat: is cut short"):
        read_splat(tmp_path / "b.splat")
    for read in (read_glb, read_splat, glb_provenance):
        with pytest.raises(UikaError, match="none"):
            read(tmp_path / "none")


def test_thinned_avatar_still_covers_the_head(avatar, head):
    fewer = thinned(avatar, len(avatar) // 2)
    assert len(fewer) == len(avatar) // 2 and thinned(avatar, 10**9) is avatar
    camera = neutral_camera(avatar, size=SIZE)
    alphas = [render(a, HeadParameters.zeros(head), camera, head).alpha for a in (avatar, fewer)]
    assert (alphas[0] - alphas[1]).abs().mean() < 0.02
    with pytest.raises(UikaError, match="count"):
        thinned(avatar, 0)


def test_a_bust_glued_to_flame_is_left_out_of_what_flame_moves(tmp_path: Path) -> None:
    whole = dataclasses.replace(load_head(), id="flame-test-bust")
    assert whole.bust is not None
    whole = dataclasses.replace(whole, bust=dataclasses.replace(whole.bust, head_id="flame-test"))
    avatar = dataclasses.replace(painted_bust(load_head()), head_id=whole.id)
    beside = write_bound_ply(tmp_path / "bound.ply", avatar, whole)
    assert beside is not None
    with np.load(beside) as arrays:
        assert arrays["static_offset"].shape == (1, whole.bust.vertex, 3)
    text = (tmp_path / "bound.ply").read_bytes()[:400].decode("ascii", "replace")
    assert f"element vertex {int((~avatar.on_bust).sum())}" in text
