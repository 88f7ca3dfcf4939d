"""The rigged mesh: valid for Khronos' tool, drawn by three.js as the avatar is drawn here, read by trimesh."""

from __future__ import annotations

import base64
import io
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from torch.nn.functional import max_pool2d

from tests.avatars import painted_avatar
from tests.chromium import page
from tests.heads import sphere_head
from tests.served import served
from tools.setup_node import FOLDER
from uika import Avatar, HeadModel, HeadParameters, Motion, UikaError, get_motion, load_head, neutral_camera, render
from uika.export import write_obj, write_rigged_glb
from uika.export.texture import bake_texture, uv_tiles
from uika.head import pose_vertices, rest_joints
from uika.head.actions import ARKIT_ACTIONS
from uika.io.glb import read_parts
from uika.metrics import psnr
from uika.motion.presets import expression_vector

SIZE = 256
MODULES = FOLDER / "node_modules"
FACES = {"neutral": {}, "open": {"jawOpen": 0.7}, "smile": {"mouthSmileLeft": 0.8, "mouthSmileRight": 0.8}}


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head().without_bust


@pytest.fixture(scope="module")
def avatar(head: HeadModel) -> Avatar:
    """Opaque and smooth: what a textured mesh can show."""
    plain = painted_avatar(head, 256)
    colors = 0.5 + 0.4 * torch.sin(40 * plain.means)
    offset = 0.004 * torch.sin(30 * head.template)
    moved = painted_avatar(replace(head, template=head.template + offset), 256)
    identity = torch.zeros(len(head.identity_basis))
    return replace(
        moved, static_offset=offset, identity=identity, colors=colors, opacities=torch.full_like(plain.opacities, 0.999)
    )


@pytest.fixture(scope="module")
def motion(head: HeadModel) -> Motion:
    talk = get_motion("talk", head)
    turned = torch.linspace(0, 1, len(talk))[:, None] * torch.tensor([[0.2, 0.5, -0.2]])
    return Motion(**{**talk.tensors(), "rotation": turned, "translation": 0.02 * turned}, fps=talk.fps)


def two_tiles(head: HeadModel) -> HeadModel:
    """The same head whose upper half lies in a second UV tile."""
    upper = head.template[head.faces][..., 1].mean(1) > 0
    uvs = torch.cat((head.uvs, head.uvs + torch.tensor([1.0, 0.0])))
    return replace(head, uvs=uvs, uv_faces=torch.where(upper[:, None], head.uv_faces + len(head.uvs), head.uv_faces))


def test_mesh_has_the_actions_joints_and_provenance(avatar, head, motion, tmp_path):
    mesh = write_rigged_glb(tmp_path / "a.glb", avatar, head, motion, size=128)
    document, _ = read_parts(tmp_path / "a.glb")
    assert set(document["meshes"][0]["extras"]["targetNames"]) == set(ARKIT_ACTIONS)
    assert [node["name"] for node in document["nodes"]][:5] == ["root", "neck", "jaw", "left_eye", "right_eye"]
    assert document["asset"]["extras"]["provenance"]["note"] == "ünïcode"
    assert np.allclose(mesh.weights.sum(1), 1, atol=1e-6) and mesh.joint_ids.max() < 5
    still = HeadParameters.zeros(head).replace(identity=avatar.identity)
    assert np.allclose(mesh.joints, rest_joints(head, still).numpy(), atol=1e-7)
    channels = {c["target"]["path"] for c in document["animations"][0]["channels"]}
    assert channels == {"rotation", "translation", "weights"}


def test_skinning_as_gltf_defines_it_is_ours(avatar, head, motion):
    """Vertices by joint matrices and morphs, computed from the file's own numbers."""
    from uika.export.mesh import skinned_mesh
    from uika.export.rigged import quaternions
    from uika.head.model import JOINT_PARENTS

    mesh, frame = skinned_mesh(avatar, head), 60
    params = motion.parameters(avatar.identity)[frame]
    truth = pose_vertices(head, params, avatar.static_offset)[mesh.vertex].numpy()
    turns = [motion.rotation, motion.neck, motion.jaw, motion.eyes[:, :3], motion.eyes[:, 3:]]
    world = np.zeros((5, 4, 4))
    for joint, parent in enumerate(JOINT_PARENTS):
        x, y, z, w = quaternions(turns[joint])[frame].astype(np.float64)
        local = np.eye(4)
        local[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        local[:3, 3] = mesh.joints[joint] - (mesh.joints[parent] if parent >= 0 else -params.translation.numpy())
        world[joint] = local if parent < 0 else world[parent] @ local
    morphed = mesh.positions + sum(float(params.expression[k]) * moved for k, moved in enumerate(mesh.morphs.values()))
    unbound = world.copy()
    unbound[:, :3, 3] -= np.einsum("jab,jb->ja", world[:, :3, :3], mesh.joints)
    skin = np.einsum("nk,nkab->nab", mesh.weights, unbound[mesh.joint_ids])
    found = np.einsum("nab,nb->na", skin[:, :3, :3], morphed) + skin[:, :3, 3]
    assert np.abs(found - truth).max() < 2e-5


@pytest.mark.skipif(
    not (MODULES / "gltf-validator").is_dir() or not shutil.which("node"), reason="no gltf-validator: make node"
)
@pytest.mark.parametrize("tiles", [1, 2])
def test_khronos_validator_has_nothing_to_say(avatar, head, motion, tmp_path, tiles):
    model = head if tiles == 1 else two_tiles(head)
    write_rigged_glb(tmp_path / "a.glb", avatar, model, motion, size=64)
    script = (
        f"const v = require({str(MODULES / 'gltf-validator')!r}), fs = require('fs');"
        "v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1]))).then((r) => console.log(JSON.stringify(r)))"
    )
    done = subprocess.run(["node", "-e", script, str(tmp_path / "a.glb")], capture_output=True, text=True, check=True)
    report = json.loads(done.stdout)
    assert report["issues"]["messages"] == []
    assert report["info"]["materialCount"] == tiles and report["info"]["hasMorphTargets"] and report["info"]["hasSkins"]


@pytest.mark.skipif(not (MODULES / "three").is_dir(), reason="no three.js: make node")
def test_three_js_shows_what_the_rasterizer_shows(avatar, head, motion, tmp_path):
    write_rigged_glb(tmp_path / "avatar.glb", avatar, head, motion)
    shutil.copy(Path(__file__).with_name("three.html"), tmp_path / "index.html")
    (tmp_path / "three").symlink_to(MODULES / "three")
    with served(tmp_path) as address, page(tmp_path) as tab:
        tab.open(f"{address}/index.html")
        tab.wait("!!window.ready")
        assert set(tab.run("names")) == set(ARKIT_ACTIONS) and len(tab.run("joints")) == 5
        rest = HeadParameters.zeros(head).replace(identity=avatar.identity)
        found, shown = [], []
        cases = [(morphs, None, rest.replace(expression=expression_vector(head, morphs))) for morphs in FACES.values()]
        cases.append(({}, 60 / motion.fps, motion.parameters(avatar.identity)[60]))
        for morphs, seconds, params in cases:
            camera = neutral_camera(avatar, 20.0, 5.0, SIZE)
            forward = camera.viewmat[2, :3]
            eye = {"eye": camera.position.tolist(), "target": (camera.position + forward).tolist(), "fov": 20.0}
            url = tab.run(f"show({SIZE}, {json.dumps(morphs)}, {json.dumps(seconds)}, {json.dumps(eye)})")
            with Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))) as file:
                picture = torch.from_numpy(np.array(file.convert("RGB"))) / 255
            ours = render(avatar, params, camera, head)
            away = max_pool2d((ours.alpha < 0.99).float()[None], 7, 1, 3)[0] > 0
            outline = ((picture < 0.999).any(-1) != (ours.alpha > 0.5)).float().mean()
            found.append((psnr(picture[~away][None], ours.rgb[~away][None].clamp(0, 1)), float(outline)))
            shown.append((picture, ours.rgb.clamp(0, 1)))
        print(found)
        # Splats end softly, about a pixel beyond the surface: 1 % of the picture along the outline.
        assert all(inside > 30 and outline < 0.02 for inside, outline in found)
        # Where a face moves, its picture is nearer to its own than to the neutral one.
        for picture, ours in shown[1:3]:
            moved = (ours - shown[0][1]).abs().amax(-1) > 0.1
            own, other = ((picture - seen)[moved].abs().mean() for seen in (ours, shown[0][1]))
            assert int(moved.sum()) > 100 and own < 0.75 * other
        assert tab.problems == []


def test_trimesh_reads_both_files_back(avatar, head, tmp_path):
    write_rigged_glb(tmp_path / "a.glb", avatar, head, size=128)
    params = HeadParameters.zeros(head).replace(expression=expression_vector(head, {"jawOpen": 0.7}))
    beside = write_obj(tmp_path / "a.obj", avatar, head, params, size=128)
    assert sorted(path.name for path in beside) == ["a.mtl", "a_0.png"]
    neutral = trimesh.load(tmp_path / "a.glb").to_geometry()
    opened = trimesh.load(tmp_path / "a.obj", process=False)
    assert len(neutral.faces) == len(opened.faces) == len(head.faces)
    posed = pose_vertices(head, params, avatar.static_offset)
    assert np.allclose(sorted(opened.vertices[:, 1])[0], float(posed[:, 1].min()), atol=2e-6)
    assert opened.visual.material.image.size == (128, 128)
    at = opened.visual.to_color().vertex_colors[:, :3].mean(0)
    assert np.abs(at - 255 * avatar.colors.mean(0).numpy()).max() < 25


def test_texture_has_the_gaussians_colours_and_no_holes(avatar, head):
    picture = bake_texture(avatar, head, size=256).astype(np.float32) / 255
    uv = (head.uvs[head.uv_faces[avatar.triangle]] * avatar.barycentric[..., None]).sum(1).numpy()
    column, row = (uv[:, 0] * 256).astype(int), ((1 - uv[:, 1]) * 256).astype(int)
    error = np.abs(picture[row, column] - avatar.colors.numpy()).max(1)
    assert np.median(error) < 0.01 and np.quantile(error, 0.99) < 0.1
    assert picture.min() > 0.05  # black would be a hole: no colour of this avatar is


def test_heads_with_two_tiles_get_two_textures(avatar, head, tmp_path):
    split = two_tiles(head)
    assert uv_tiles(split).unique().tolist() == [0, 1]
    mesh = write_rigged_glb(tmp_path / "a.glb", avatar, split, size=64)
    assert mesh.uvs.min() >= 0 and mesh.uvs.max() <= 1 and sum(map(len, mesh.faces.values())) == len(head.faces)
    whole, part = bake_texture(avatar, head, size=64), bake_texture(avatar, split, 1, size=64)
    place = (head.uvs[head.uv_faces[uv_tiles(split) == 1]].mean(1) * 64).long()
    rows, columns = 63 - place[:, 1], place[:, 0]
    assert np.abs(whole[rows, columns].astype(int) - part[rows, columns]).mean() < 3
    names = [path.name for path in write_obj(tmp_path / "a.obj", avatar, split, size=64)]
    assert names == ["a.mtl", "a_0.png", "a_1.png"]


def test_a_bust_is_the_second_tile(tmp_path):
    whole = load_head()
    assert whole.bust is not None and uv_tiles(whole).unique().tolist() == [0, 1]
    avatar = painted_avatar(whole, 64)
    mesh = write_rigged_glb(tmp_path / "a.glb", avatar, whole, size=64)
    assert sum(map(len, mesh.faces.values())) == len(whole.faces) and set(mesh.faces) == {0, 1}
    assert bake_texture(avatar, whole, 1, size=64).min() > 10  # without Gaussians there, the avatar's mean colour


def test_nothing_is_half_written(head, tmp_path):
    small = sphere_head()
    avatar = painted_avatar(small, 32)
    with pytest.raises(UikaError, match=r"must end in \.glb"):
        write_rigged_glb(tmp_path / "a.gltf", avatar, small)
    with pytest.raises(UikaError, match="was made for the head model"):
        write_rigged_glb(tmp_path / "a.glb", avatar, head)
    with pytest.raises(UikaError, match="was made for the head model"):
        write_obj(tmp_path / "a.obj", avatar, head)
    assert list(tmp_path.iterdir()) == []
