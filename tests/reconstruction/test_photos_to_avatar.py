"""From a real photo to a moving head, with the figures the project promises."""

from pathlib import Path

import pytest
import torch

from benchmarks.head_quality import mesh_figures, photograph, photos_figures, portrait_figures
from tests.agreement import assert_same_avatar
from uika.assets import PORTRAIT
from uika.avatar import Avatar
from uika.avatar.rendering import render
from uika.head import HeadModel, HeadParameters, load_head, look_at, project, uv_texels
from uika.model import build, save_checkpoint
from uika.photo_splats import LIMIT
from uika.reconstruction import Reconstruction, Report, avatar_from_fit, load_model, reconstruct
from uika.reconstruction.bust import wider_camera


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head().without_bust


@pytest.fixture(scope="module")
def portrait(head: HeadModel) -> Reconstruction:
    return reconstruct([PORTRAIT], head)


@pytest.fixture(scope="module")
def surface(head: HeadModel) -> Reconstruction:
    """Without photo splats: what the mesh can show."""
    return reconstruct([PORTRAIT], head, photo_splats=False)


def test_avatar_looks_like_its_photo(portrait: Reconstruction, head: HeadModel) -> None:
    figures, _ = portrait_figures(portrait, head)
    print(figures)
    assert figures.face_psnr >= 24
    assert figures.silhouette_iou >= 0.85
    assert figures.landmark_percent <= 2.5
    assert figures.gaussians >= 40_000


def test_hair_is_kept(portrait: Reconstruction, head: HeadModel) -> None:
    params = HeadParameters.zeros(head).replace(identity=portrait.avatar.identity)
    camera = look_at(0.0, 0.0, 1.2, fov_y=20.0, size=256)
    with_hair = render(portrait.avatar, params, camera, head).alpha.sum()
    lifted = portrait.avatar.static_offset.norm(dim=-1)
    assert lifted.max() > 0.03
    assert lifted.max() <= 0.1 + 1e-6
    assert with_hair > 0.15 * 256 * 256


def test_splats_agree_with_mitsuba(surface: Reconstruction, head: HeadModel) -> None:
    for figures in mesh_figures(surface.avatar, head):
        print(figures)
        assert figures.mask_iou >= 0.95
        assert figures.depth_median_mm <= 3.0


def test_network_at_its_start_keeps_the_surface(portrait: Reconstruction, head: HeadModel, tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "start.safetensors", build("tiny"))
    images, mattes = (torch.stack([getattr(photo, name) for photo in portrait.photos]) for name in ("image", "matte"))
    start, plain = (
        avatar_from_fit(load_model(model), head, portrait.fit, images, mattes, ["photo"], Report())
        for model in (tmp_path / "start.safetensors", "none")
    )
    assert torch.equal(plain.means, start.means)
    assert (plain.colors - start.colors).abs().max() < 2e-3


def test_built_in_network_colours_what_is_hidden_off_the_face_alone(surface: Reconstruction, head: HeadModel) -> None:
    plain, trained = reconstruct([PORTRAIT], head, "none", photo_splats=False).avatar, surface.avatar
    for name in ("means", "quats", "scales", "opacities"):
        torch.testing.assert_close(getattr(trained, name), getattr(plain, name), rtol=0, atol=1e-7)
    change = (plain.colors - trained.colors).abs().mean(-1)
    binding = uv_texels(head, 384)
    face = (head.masks["face"][head.faces[binding.triangle]] * binding.barycentric).sum(-1)
    assert change[face == 1].max() < 1e-6
    assert 0.005 < change[face == 0].median() < 0.1
    assert surface.fit is not None
    shown = [render(a, surface.fit.parameters[0], surface.fit.cameras[0], head).rgb for a in (plain, trained)]
    assert (shown[0] - shown[1]).abs().mean() < 0.003


def test_photo_splats_show_the_person_outside_the_surface(
    portrait: Reconstruction, surface: Reconstruction, head: HeadModel, tmp_path: Path
) -> None:
    count = portrait.report.counts["photo_splats"]
    assert 1_000 < count <= LIMIT
    assert portrait.avatar.provenance["photo_splats"] == str(count)
    plain = surface
    assert "photo_splats" not in plain.report.counts
    assert len(portrait.avatar) == len(plain.avatar) + count
    photo, errors, sizes = portrait.photos[0], [], []
    for result in (plain, portrait):
        shown = render(result.avatar, result.fit.parameters[0], result.fit.cameras[0], head)
        errors.append((shown.rgb.permute(2, 0, 1) - photo.image).square().mean())
        result.avatar.save(tmp_path / "avatar.safetensors")
        sizes.append((tmp_path / "avatar.safetensors").stat().st_size)
    assert errors[1] < 0.4 * errors[0]
    assert sizes[1] <= 1.5 * sizes[0]


def test_avatar_survives_its_file(portrait: Reconstruction, tmp_path: Path) -> None:
    portrait.avatar.save(tmp_path / "avatar.safetensors")
    loaded = Avatar.load(tmp_path / "avatar.safetensors")
    for name in ("means", "quats", "scales", "opacities", "colors", "identity", "static_offset", "triangle"):
        assert torch.equal(getattr(loaded, name), getattr(portrait.avatar, name)), name


@pytest.mark.slow
def test_any_number_of_photos(surface: Reconstruction, head: HeadModel) -> None:
    for figures in photos_figures(surface.avatar, head, counts=(1, 2, 4)):
        print(figures)
        assert figures.seen_psnr >= 20


def test_two_photos_of_a_known_head(surface: Reconstruction, head: HeadModel, tmp_path: Path) -> None:
    from PIL import Image

    paths = []
    for yaw in (0.0, 30.0):
        picture = photograph(surface.avatar, head, yaw, spp=16)[0]
        paths.append(tmp_path / f"view{yaw:.0f}.png")
        Image.fromarray((picture * 255).round().to(torch.uint8).numpy()).save(paths[-1])
    result = reconstruct(paths, head, photo_splats=False)
    assert len(result.fit.error) == 2
    assert result.fit.error.max() < 0.03
    back = reconstruct(paths[::-1], head, photo_splats=False)
    assert [photo.sha256 for photo in back.photos] == [photo.sha256 for photo in result.photos]
    assert_same_avatar(back.avatar, result.avatar)


def test_a_bust_is_added_to_an_unchanged_head(surface: Reconstruction, head: HeadModel) -> None:
    whole = load_head()
    assert whole.bust is not None
    result = reconstruct([PORTRAIT], whole, photo_splats=False)
    avatar, count = result.avatar, len(surface.avatar)
    assert (avatar.head_id, avatar.bust_triangle) == ("builtin-2", whole.bust.face)
    assert torch.equal(avatar.on_bust, torch.arange(len(avatar)) >= count)
    # Sums over threads are not the same to the last bit in two runs.
    for name in ("means", "quats", "scales", "opacities", "colors", "triangle", "barycentric"):
        difference = (getattr(avatar, name)[:count].double() - getattr(surface.avatar, name)).abs()
        assert (difference > 1e-3).double().mean() < 1e-3, name
    torch.testing.assert_close(avatar.identity, surface.avatar.identity, atol=1e-4, rtol=0)
    torch.testing.assert_close(
        avatar.static_offset[: whole.bust.vertex], surface.avatar.static_offset, atol=1e-4, rtol=0
    )
    lifted = avatar.static_offset[whole.bust.vertex :].norm(dim=-1)
    assert 0.02 < lifted.max() < 0.13
    suit = avatar.colors[avatar.on_bust & (avatar.means[:, 2] > 0) & (avatar.means[:, 1] < -0.22)]
    assert suit[:, 0].median() > 1.8 * suit[:, 2].median()  # an orange one


def test_the_bust_covers_the_person_in_the_photo(head: HeadModel) -> None:
    whole = load_head()
    result = reconstruct([PORTRAIT], whole, "none")
    photo, camera = result.photos[0], result.fit.cameras[0]
    assert photo.bust is not None
    rest = result.fit.parameters[0]
    wide = wider_camera(camera, photo)
    alpha = render(result.avatar, rest, wide, whole).alpha
    # Rows from the crown down to where the bust begins to fade.
    low = project(result.avatar.means[result.avatar.on_bust], wide)[0][:, 1].max() - 30
    rows = torch.arange(len(alpha)) < low
    shown, covered = photo.bust.matte[rows] > 0.5, alpha[rows] > 0.5
    assert float((shown & covered).sum() / (shown | covered).sum()) > 0.93
    # The collar beside the jaw lies where the shoulders do, not before the cheek.
    count = int(result.avatar.provenance["photo_splats"])
    added = torch.arange(len(result.avatar)) >= len(result.avatar) - count
    clothes = result.avatar.means[added & result.avatar.on_bust]
    face = result.avatar.canonical_vertices(whole)[whole.masks["face"] > 0.5]
    assert len(clothes) > 500 and torch.cdist(clothes, face).min() > 0.03
