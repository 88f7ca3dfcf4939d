from dataclasses import replace

import av
import pytest
import torch
from PIL import Image

from uika import (
    HeadParameters,
    UikaError,
    frames,
    get_motion,
    neutral_camera,
    render,
    write_png,
    write_video,
)
from uika.avatar.framing import motion_cameras
from uika.cli.contact_sheet import contact_sheet
from uika.errors import UikaWarning
from uika.io.video import to_bytes

SIZE = 96


def _center(picture):
    return picture[SIZE // 2 - 6 : SIZE // 2 + 6]


def test_colours_alpha_depth_and_background(avatar, head):
    camera = neutral_camera(avatar, size=SIZE)
    picture = render(avatar, HeadParameters.zeros(head), camera, head, (0.2, 0.4, 0.6), depth=True)
    assert picture.rgb.shape == (SIZE, SIZE, 3) and picture.alpha.shape == (SIZE, SIZE)
    # The subject's left is on the picture's right.
    left, right = picture.rgb[SIZE // 2, SIZE // 2 + 15], picture.rgb[SIZE // 2, SIZE // 2 - 15]
    torch.testing.assert_close(left, torch.tensor([0.9, 0.1, 0.1]), atol=0.02, rtol=0)
    torch.testing.assert_close(right, torch.tensor([0.1, 0.1, 0.9]), atol=0.02, rtol=0)
    torch.testing.assert_close(picture.rgb[2, 2], torch.tensor([0.2, 0.4, 0.6]))
    assert _center(picture.alpha)[:, 36:60].min() > 0.98
    assert picture.alpha[0].max() == 0 and picture.depth is not None and picture.depth[0, 0] == 0
    nearest = camera.position.norm() - 0.09
    assert (picture.depth[SIZE // 2, SIZE // 2] - nearest).abs() < 0.01


@pytest.mark.parametrize("yaw", [0.0, 45.0, -90.0, 180.0])
@pytest.mark.parametrize("pitch", [0.0, 40.0])
def test_neutral_camera_holds_the_whole_head(avatar, head, yaw, pitch):
    alpha = render(avatar, HeadParameters.zeros(head), neutral_camera(avatar, yaw, pitch, SIZE), head).alpha
    assert max(alpha[0].max(), alpha[-1].max(), alpha[:, 0].max(), alpha[:, -1].max()) == 0
    covered = (alpha > 0.5).nonzero()
    assert (covered.amax(0) - covered.amin(0)).max() > 0.7 * SIZE


def test_turning_the_head_shows_the_other_side(avatar, head):
    camera = neutral_camera(avatar, size=SIZE)
    turned = HeadParameters.zeros(head).replace(rotation=torch.tensor([0.0, 1.3, 0.0]))
    rest = HeadParameters.zeros(head)
    front, moved = (_center(render(avatar, params, camera, head).rgb)[:, 20:76] for params in (rest, turned))
    assert moved[..., 2].mean() > front[..., 2].mean() + 0.2


def test_frames_follow_the_motion_and_its_camera(avatar, head):
    motion = get_motion("orbit", head, 2.0)
    cameras = motion_cameras(avatar, motion, SIZE)
    pictures = list(frames(avatar, motion, head=head, size=SIZE))
    assert len(pictures) == len(motion) == 8
    red = [float(picture.rgb[..., 0].sum() - picture.rgb[..., 2].sum()) for picture in pictures]
    assert red[2] > red[0] > red[6]
    single = render(avatar, motion.parameters(avatar.identity)[3], cameras[3], head)
    assert torch.equal(single.rgb, pictures[3].rgb)


def test_render_refuses_batches_and_impossible_views(avatar, head):
    camera = neutral_camera(avatar, size=SIZE)
    with pytest.raises(UikaError, match="batch"):
        render(avatar, HeadParameters.zeros(head, 2), camera, head)
    for yaw, pitch, size in ((float("nan"), 0, 64), (0, 90, 64), (0, float("nan"), 64), (0, 0, 8), (0, 0, 5000)):
        with pytest.raises(UikaError, match=r"yaw|pitch|size"):
            neutral_camera(avatar, yaw, pitch, size)


def test_video_has_the_frames_that_went_in(tmp_path):
    levels = torch.linspace(0.1, 0.9, 7)
    path = tmp_path / "new" / "v.mp4"
    assert write_video(path, (torch.full((34, 48, 3), float(level)) for level in levels), 12.5) == 7
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height, stream.codec_context.name) == (48, 34, "h264")
        assert stream.pix_fmt == "yuv420p" and float(stream.average_rate) == 12.5
        means = [frame.to_ndarray(format="rgb24").mean() / 255 for frame in container.decode(video=0)]
    assert means == pytest.approx(levels.tolist(), abs=0.02)
    assert [entry.name for entry in path.parent.iterdir()] == ["v.mp4"]


def _failing():
    yield torch.zeros(32, 32, 3)
    raise RuntimeError("the second picture fails")


@pytest.mark.parametrize(
    ("pictures", "error"),
    [
        (_failing, RuntimeError),
        (lambda: iter(()), UikaError),
        (lambda: iter([torch.zeros(33, 32, 3)]), UikaError),
        (lambda: iter([torch.zeros(32, 32, 3), torch.zeros(32, 34, 3)]), UikaError),
    ],
)
def test_failed_video_leaves_nothing(tmp_path, pictures, error):
    with pytest.raises(error):
        write_video(tmp_path / "v.mp4", pictures(), 25)
    assert list(tmp_path.iterdir()) == []


def test_failed_video_keeps_the_old_file(tmp_path):
    path = tmp_path / "v.mp4"
    path.write_bytes(b"old")
    with pytest.raises(RuntimeError):
        write_video(path, _failing(), 25)
    assert path.read_bytes() == b"old"


def test_png_is_exact_and_clipped(tmp_path):
    rgb = torch.rand(5, 7, 3, generator=torch.Generator().manual_seed(0)) * 1.4 - 0.2
    write_png(tmp_path / "p.png", rgb)
    with Image.open(tmp_path / "p.png") as picture:
        assert picture.size == (7, 5) and picture.tobytes() == to_bytes(rgb).tobytes()


@pytest.mark.parametrize("name", ["p.jpg", "p", "folder.png", "file/p.png"])
def test_unusable_output_names_are_refused(tmp_path, name):
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "file").write_text("")
    with pytest.raises(UikaError, match=name.split("/")[0]):
        write_png(tmp_path / name, torch.zeros(4, 4, 3))


def test_contact_sheet_places_pictures_and_labels():
    colors = torch.eye(3)
    cells = [(f"cell {index}", color.expand(20, 30, 3)) for index, color in enumerate(colors)]
    sheet = contact_sheet(cells, columns=2, cell=40)
    assert sheet.shape[1] == 80 and sheet.shape[0] % 2 == 0
    row = sheet.shape[0] // 2
    torch.testing.assert_close(sheet[20, 20], colors[0])
    torch.testing.assert_close(sheet[20, 60], colors[1])
    torch.testing.assert_close(sheet[row + 20, 20], colors[2])
    assert sheet[41:row, :40].min() < 0.5 and sheet[row:, 40:].min() == 1


@pytest.mark.parametrize("shift", [(0.0, 0.0, 3.0), (1.0, 0.0, 0.0), (0.0, -0.8, 0.0), (0.0, 0.0, 40.0)])
def test_a_translation_out_of_the_picture_is_spoken_of(avatar, head, shift):
    still = get_motion("talk", head, 10.0)
    assert len(motion_cameras(avatar, still, SIZE).viewmat) == len(still)
    away = torch.zeros(len(still), 3)
    away[5:] = torch.tensor(shift)
    moved = replace(still, translation=away)
    if shift[2] > 20:  # behind the camera
        assert float(neutral_camera(avatar, size=SIZE).position[2]) < 40
    with pytest.warns(
        UikaWarning, match=rf"out of the picture in {len(still) - 5} of {len(still)} frames, first in .* 5;"
    ):
        motion_cameras(avatar, moved, SIZE)


@pytest.mark.parametrize("shift", [(0.02, 0.0, 0.0), (0.0, 0.03, -0.1), (0.0, 0.0, -2.0)])
def test_small_translations_are_nothing_to_speak_of(avatar, head, shift):
    still = get_motion("talk", head, 10.0)
    motion_cameras(avatar, replace(still, translation=torch.tensor(shift).expand(len(still), 3)), SIZE)
