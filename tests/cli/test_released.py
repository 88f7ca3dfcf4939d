"""From a file under the released names to a moving avatar, by commands; FLAME is made up, weights are random."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from tests.exports import bare_flame, write_export, write_flame
from tests.heads import released_parity
from tests.model.released_files import SMALL
from tests.model.restatement import Restatement
from tests.released_heads import PREFIX, released_tensors, tables, write_released
from uika.assets import PORTRAIT
from uika.avatar import Avatar
from uika.avatar.frame_renderer import film
from uika.avatar.rendering import frames
from uika.cli import main
from uika.head import HeadParameters, load_head, save_head
from uika.io.video import to_bytes
from uika.model import CheckpointError, released
from uika.model.released_binding import template_binding
from uika.motion import Motion
from uika.photo import prepare
from uika.photo.square_view import prepare_reference


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("released")
    save_head(bare_flame(), place / "flame.npz")
    write_released(place)
    return place


@pytest.fixture(scope="module")
def avatar(folder: Path) -> Avatar:
    words = ["--model", str(folder / "uika.safetensors"), "--head", str(folder / "flame.npz")]
    assert main(["reconstruct", str(PORTRAIT), *words, "-o", str(folder / "me.safetensors")]) == 0
    return Avatar.load(folder / "me.safetensors")


def sentence(capsys: pytest.CaptureFixture[str]) -> str:
    return " ".join(capsys.readouterr().err.split())


def test_the_command_gives_the_released_gaussians(folder: Path, avatar: Avatar) -> None:
    photo = prepare(PORTRAIT)
    image, mask = prepare_reference(photo.original.permute(1, 2, 0).numpy(), photo.matte.numpy())
    images, masks = image[None, None], mask[None, None, None]
    expected = Restatement(released_tensors(), SMALL.backbone.taps, SMALL.outputs)
    uv = released.load(folder / "uika.safetensors").estimate(images)
    assert float((uv.double() - expected.estimate(images)).abs().max()) < 5e-5
    for name, value in expected(images, masks, uv).items():
        if hasattr(avatar, name):
            assert float((getattr(avatar, name).double() - value[0]).abs().max()) < 1e-4, name
    assert {"means", "quats", "scales", "opacities", "colors"} <= set(expected(images, masks, uv))
    assert avatar.skinning == "released" and float(avatar.identity.abs().max()) == 0
    assert avatar.provenance["model"] == "released (uika.safetensors)"


def test_bfloat16_gives_nearly_the_same(folder: Path, avatar: Avatar, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--model", str(folder / "uika.safetensors"), "--head", str(folder / "flame.npz")]
    given = [*words, "--precision", "bfloat16", "-o", str(folder / "half.safetensors")]
    assert main(["reconstruct", str(PORTRAIT), *given]) == 0
    half = Avatar.load(folder / "half.safetensors")
    assert half.provenance["model"] == "released (uika.safetensors) in bfloat16"
    # Eight bits of an offset of up to 0.2 m, and a network of random values before it: machines differ by a tenth.
    assert 0 < float((half.means - avatar.means).abs().max()) < 5e-3
    assert float((half.colors - avatar.colors).abs().mean()) < 0.01
    none = ["--precision", "bfloat16", "-o", str(folder / "none.safetensors")]
    assert main(["reconstruct", str(PORTRAIT), *none]) == 2
    assert "--precision bfloat16: model 'tiny' is small and runs in float32" in sentence(capsys)


def test_gaussians_are_moved_as_released(tmp_path: Path) -> None:
    """The authors' own numbers for points bound to a synthetic head, through the avatar's file."""
    data, head = released_parity()
    offset = data["in/offset"]
    for row in range(len(offset)):
        binding = tables(head, 40)
        corners, mix = binding[PREFIX + "pix_to_v_idx_flatten"], binding[PREFIX + "pix_bary_flatten"]
        place = {tuple(face): at for at, face in enumerate(head.faces.tolist())}
        count = len(corners)
        means = data["w/v_template_pix"] + offset[row]
        made = Avatar(
            head_id=head.id,
            identity=torch.zeros(len(head.identity_basis)),
            static_offset=torch.zeros_like(head.template),
            means=means,
            quats=torch.eye(4)[:1].repeat(count, 1),
            scales=torch.full((count, 3), 1e-3),
            opacities=torch.ones(count),
            colors=torch.ones(count, 3),
            triangle=torch.tensor([place[tuple(face)] for face in corners.tolist()]),
            barycentric=mix,
            skinning="released",
        )
        made.save(tmp_path / "a.safetensors")
        names = {"expression": "expr", "rotation": "rotation", "neck": "neck", "jaw": "jaw", "eyes": "eyes"}
        params = HeadParameters.zeros(head).replace(
            **{field: data[f"in/{name}"][row] for field, name in {**names, "translation": "translation"}.items()}
        )
        posed, quats, _ = Avatar.load(tmp_path / "a.safetensors").pose(params, head)
        torch.testing.assert_close(posed, data["out/gs_animated"][row], rtol=0, atol=1e-6)
        assert torch.equal(quats, made.quats)


def test_the_files_own_table_binds_to_the_head() -> None:
    data, head = released_parity()
    model = type("Model", (), {})()
    model.network = type("Network", (), {"config": replace(SMALL, map_size=40)})()
    model.texel = data["w/valid_mask_flatten"].bool().nonzero()[:, 0]
    model.corners, model.barycentric = data["w/pix_to_v_idx_flatten"], data["w/pix_bary_flatten"]
    model.points = data["w/v_template_pix"]
    binding = template_binding(model, head, "uika.safetensors")
    corners = head.template[head.faces[binding.triangle]]
    torch.testing.assert_close((corners * binding.barycentric[..., None]).sum(1), model.points, rtol=0, atol=1e-6)
    model.corners = model.barycentric = None
    assert len(template_binding(model, head, "uika.safetensors")) == len(binding)


def test_films_are_what_single_frames_are(folder: Path, avatar: Avatar) -> None:
    head = load_head(folder / "flame.npz")
    count = len(head.expression_names)
    motion = Motion(
        expression=0.5 * torch.randn(2, count, generator=torch.Generator().manual_seed(1)).clamp(-1, 1),
        rotation=torch.tensor([[0.0, 0.3, 0.0], [0.1, -0.2, 0.0]]),
        neck=torch.zeros(2, 3),
        jaw=torch.tensor([[0.3, 0.0, 0.0], [0.0, 0.0, 0.0]]),
        eyes=torch.zeros(2, 6),
        translation=torch.zeros(2, 3),
        fps=25.0,
    )
    filmed = list(film(avatar, motion, head=head, size=96))
    single = [to_bytes(each.rgb) for each in frames(avatar, motion, head=head, size=96)]
    assert max(int(np.abs(a.astype(int) - b).max()) for a, b in zip(filmed, single, strict=True)) <= 1
    carried = list(film(replace(avatar, skinning="surface"), motion, head=head, size=96))
    assert max(int(np.abs(a.astype(int) - b).max()) for a, b in zip(filmed, carried, strict=True)) > 8


def test_flame_parameters_move_the_avatar(folder: Path, avatar: Avatar) -> None:
    del avatar
    arrays = {"expr": np.zeros((3, 100)), "jaw_pose": np.zeros((3, 3)), "rotation": np.zeros((3, 3))}
    arrays["jaw_pose"][:, 0] = (0.0, 0.1, 0.2)
    np.savez(folder / "flame_param.npz", **arrays)
    words = ["--motion", str(folder / "flame_param.npz"), "--head", str(folder / "flame.npz"), "--size", "64"]
    assert main(["animate", str(folder / "me.safetensors"), *words, "-o", str(folder / "me.mp4")]) == 0
    assert (folder / "me.mp4").stat().st_size > 1000


def refused(folder: Path, *words: str, head: str | None = "flame.npz", model: str = "uika.safetensors") -> int:
    chosen = [] if head is None else ["--head", str(folder / head)]
    arguments = ["--model", str(folder / model), *chosen, *words, "-o", str(folder / "none.safetensors")]
    code = main(["reconstruct", str(PORTRAIT), *arguments])
    assert not (folder / "none.safetensors").exists()
    return code


def test_another_head_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert refused(folder, head=None) == 2
    said = sentence(capsys)
    assert "uika.safetensors" in said and "uika head import" in said
    flame = bare_flame()
    save_head(replace(flame, id="flame-2020", template=flame.template * 1.01), folder / "other.npz")
    assert refused(folder, head="other.npz") == 2
    assert "was trained on another mean head than 'flame-2020', up to" in sentence(capsys)
    save_head(replace(flame, id="mirrored", uvs=1 - flame.uvs), folder / "turned.npz")
    assert refused(folder, head="turned.npz") == 2
    assert "texels lie elsewhere in the texture coordinates of the head model 'mirrored'" in sentence(capsys)
    # The order of triangles and of their corners is no other head.
    turned = replace(flame, id="same", faces=flame.faces.flip(0).roll(1, 1), uv_faces=flame.uv_faces.flip(0).roll(1, 1))
    model = released.load(folder / "uika.safetensors")
    binding = template_binding(model, turned, "uika.safetensors")
    points = (turned.template[turned.faces[binding.triangle]] * binding.barycentric[..., None]).sum(1)
    torch.testing.assert_close(points, model.points, rtol=0, atol=1e-6)


def test_a_backbone_of_its_own_file(folder: Path, avatar: Avatar, capsys: pytest.CaptureFixture[str]) -> None:
    tensors = released_tensors()
    inside = {name: value for name, value in tensors.items() if name.startswith("encoder.model.")}
    lean = write_released(folder, "lean.safetensors", **{name.replace(".", "__"): None for name in inside})
    assert refused(folder, model="lean.safetensors") == 2
    assert "lean.safetensors: holds no image encoder of its own; give the DINOv3 backbone of 32 channels" in sentence(
        capsys
    )
    own = {name.removeprefix("encoder.model."): value.contiguous() for name, value in inside.items()}
    save_file(own, folder / "dinov3.safetensors")
    model = released.load(lean, backbone=folder / "dinov3.safetensors")
    whole = released.load(folder / "uika.safetensors")
    for (name, one), (_, other) in zip(model.state_dict().items(), whole.state_dict().items(), strict=True):
        assert torch.equal(one, other), name
    words = ["--model", str(lean), "--head", str(folder / "flame.npz")]
    given = [*words, "--backbone", str(folder / "dinov3.safetensors"), "-o", str(folder / "again.safetensors")]
    assert main(["reconstruct", str(PORTRAIT), *given]) == 0
    torch.testing.assert_close(Avatar.load(folder / "again.safetensors").means, avatar.means)
    save_file({**own, "patch_embed.proj.weight": torch.zeros(64, 3, 16, 16)}, folder / "wide.safetensors")
    assert refused(folder, "--backbone", str(folder / "wide.safetensors")) == 2
    assert "is a backbone of 64 channels, but" in sentence(capsys)


def test_files_of_the_wrong_kind_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_file({"weight": torch.zeros(3)}, folder / "other.safetensors")
    assert refused(folder, model="other.safetensors") == 2
    assert "other.safetensors: is weights of another kind, not a reconstruction model" in sentence(capsys)
    tensors = released_tensors()
    prefix = "uv_wrapper.model."
    save_file(
        {f"fuvt.{n.removeprefix(prefix)}": v.contiguous() for n, v in tensors.items() if n.startswith(prefix)},
        folder / "fuvt.safetensors",
    )
    assert refused(folder, model="fuvt.safetensors") == 2
    assert "is the released correspondence estimator, not a reconstruction model; give it with --estimator" in sentence(
        capsys
    )
    for option, said in (
        ("--estimator", "finds the texture coordinates of FLAME, not those of the head model"),
        ("--backbone", "model 'tiny' brings its own backbone"),
    ):
        words = [option, str(folder / "fuvt.safetensors"), "-o", str(folder / "none.safetensors")]
        assert main(["reconstruct", str(PORTRAIT), *words]) == 2
        assert said in sentence(capsys)


def test_an_estimator_of_its_own_file(folder: Path, avatar: Avatar) -> None:
    tensors = released_tensors()
    prefix = "uv_wrapper.model."
    save_file(
        {f"fuvt.{n.removeprefix(prefix)}": v.contiguous() for n, v in tensors.items() if n.startswith(prefix)},
        folder / "fuvt.safetensors",
    )
    words = ["--model", str(folder / "uika.safetensors"), "--head", str(folder / "flame.npz")]
    given = [*words, "--estimator", str(folder / "fuvt.safetensors"), "-o", str(folder / "located.safetensors")]
    assert main(["reconstruct", str(PORTRAIT), *given]) == 0
    torch.testing.assert_close(Avatar.load(folder / "located.safetensors").colors, avatar.colors)


def test_a_template_of_another_size_is_named() -> None:
    data, head = released_parity()
    model = type("Model", (), {})()
    model.network = type("Network", (), {"config": replace(SMALL, map_size=40)})()
    model.texel = data["w/valid_mask_flatten"].bool().nonzero()[:, 0]
    model.corners, model.barycentric = data["w/pix_to_v_idx_flatten"] + len(head.template), data["w/pix_bary_flatten"]
    model.points = data["w/v_template_pix"]
    with pytest.raises(CheckpointError, match="needs a head of more than"):
        template_binding(model, head, "uika.safetensors")


def test_the_list_of_weights_says_what_each_file_unlocks(capsys: pytest.CaptureFixture[str]) -> None:
    main(["weights", "--no-verify"])
    printed = capsys.readouterr().out
    assert printed.count("unlocks  ") == 5
    for words in ("--model uika.safetensors --head flame.npz", "--estimator fuvt_15k.safetensors", "--preset base"):
        assert words in printed


@pytest.mark.slow
def test_released_weights_are_evaluated_and_moved_by_other_motions(
    folder: Path, avatar: Avatar, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    del avatar
    head = ["--head", str(write_flame(tmp_path / "flame.npz"))]
    data = write_export(tmp_path / "data" / "306_EMO-1_v16", cameras=1).parent
    words = ["--model", str(folder / "uika.safetensors"), *head, "--correspondence", "exact", "--views", "1,2"]
    assert main(["evaluate", "--data", str(data), *words, "--size", "96", "-o", str(tmp_path / "report")]) == 0
    said = capsys.readouterr().out
    assert "2 results made" in said and "model released (uika.safetensors), sha256" in said
    (tmp_path / "face.csv").write_text("Timecode,BlendshapeCount,jawOpen\n00:00:00:00.0,1,0.0\n00:00:00:01.0,1,0.8\n")
    for motion in ("talk", str(tmp_path / "face.csv")):
        film_file = tmp_path / "moved.mp4"
        given = ["--motion", motion, *head, "--size", "64", "-o", str(film_file)]
        assert main(["animate", str(folder / "me.safetensors"), *given]) == 0, capsys.readouterr().err
        assert film_file.stat().st_size > 1000
