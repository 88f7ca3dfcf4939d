"""The mark is found after ordinary handling, and nowhere else."""

import io

import av
import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import max_pool2d

from tests.avatars import painted_avatar
from uika import HeadModel, load_head, neutral_camera, render, write_video
from uika.head import HeadParameters
from uika.io.video import to_bytes
from uika.metrics import psnr
from uika.safeguards import detect, mark
from uika.safeguards.watermark import THRESHOLD, pattern


@pytest.fixture(scope="module")
def plain() -> Tensor:
    """A rendered head with some detail, on white."""
    head: HeadModel = load_head()
    avatar = painted_avatar(head, 128)
    avatar.colors.copy_(0.5 + 0.3 * torch.sin(80 * avatar.means))
    params = HeadParameters.zeros(head)
    camera = neutral_camera(avatar, 20.0, 0.0, 512)
    return render(avatar, params, camera, head).rgb.clamp(0, 1)


def _tensor(picture: Image.Image) -> Tensor:
    return torch.from_numpy(np.array(picture.convert("RGB"))).float() / 255


def _jpeg(rgb: Tensor) -> Tensor:
    memory = io.BytesIO()
    Image.fromarray(to_bytes(rgb)).save(memory, "JPEG", quality=80)
    return _tensor(Image.open(memory))


def _half(rgb: Tensor) -> Tensor:
    return _tensor(Image.fromarray(to_bytes(rgb)).resize((rgb.shape[1] // 2, rgb.shape[0] // 2)))


HANDLING = {
    "clean": lambda rgb: rgb,
    "jpeg": _jpeg,
    "half": _half,
    "crop": lambda rgb: rgb[26:-26, 30:-22],
    "half and jpeg": lambda rgb: _jpeg(_half(rgb)),
}


@pytest.mark.parametrize("name", HANDLING)
def test_mark_survives(plain, name):
    marked = detect([HANDLING[name](torch.from_numpy(mark(to_bytes(plain))) / 255)])
    unmarked = detect([HANDLING[name](plain)])
    print(f"{name}: {marked.score:.1f} at {marked.scale:.2f}, unmarked {unmarked.score:.1f}")
    assert marked.found and marked.score > 1.3 * THRESHOLD
    assert marked.scale == (0.5 if "half" in name else 1.0)
    assert not unmarked.found


def test_mark_survives_the_programs_own_videos(plain, tmp_path):
    bytes_ = to_bytes(plain)
    write_video(tmp_path / "v.mp4", (mark(np.roll(bytes_, step, 1)) for step in range(6)), 25.0)
    with av.open(str(tmp_path / "v.mp4")) as container:
        frames = [torch.from_numpy(f.to_ndarray(format="rgb24")) / 255 for f in container.decode(video=0)]
    assert detect(frames).score > 1.3 * THRESHOLD and detect(frames[3:4]).found


def test_pictures_stay_what_they_look_like(plain):
    floats, steps = mark(plain), torch.from_numpy(mark(to_bytes(plain))) / 255
    assert psnr(floats, plain) >= 45 and psnr(steps, torch.from_numpy(to_bytes(plain)) / 255) >= 45
    busy = torch.rand(256, 256, 3, generator=torch.Generator().manual_seed(1)) * 0.6 + 0.2
    assert psnr(mark(busy), busy) >= 45  # nothing is clipped here, and nothing is flat
    assert (floats - plain).abs().max() < 9 / 255
    assert floats.max() <= 1 and floats.min() >= 0
    assert torch.equal(pattern(300, 200)[:128, :72], pattern(300, 200)[128:256, 128:])
    assert pattern(300, 200).mean().abs() < 1e-4


@pytest.mark.parametrize("size", [256, 512])
def test_nothing_changes_on_flat_backgrounds(plain, size):
    """Whoever flips between both pictures sees nothing move: white, grey, and what lies beside the head."""
    picture = _tensor(Image.fromarray(to_bytes(plain)).resize((size, size)))
    for background in (1.0, 0.5, 0.0):
        behind = (picture == 1).all(-1, keepdim=True)
        beside = max_pool2d((~behind).float().permute(2, 0, 1), 5, 1, 2)[0] == 0  # two pixels from the outline
        shown = to_bytes(torch.where(behind, torch.full_like(picture, background), picture))
        change = np.abs(mark(shown).astype(int) - shown)
        assert change[beside.numpy()].max() <= 1
        assert change.max() > 2 and detect([torch.from_numpy(mark(shown)) / 255]).found
    grey = np.full((256, 256, 3), 128, np.uint8)
    ramp = np.repeat(np.linspace(100, 110, 256)[:, None, None], 256, 1).repeat(3, 2).round().astype(np.uint8)
    assert np.array_equal(mark(grey), grey)
    assert np.abs(mark(ramp).astype(int) - ramp).max() <= 1


def test_pictures_without_content_score_nothing():
    g = torch.Generator().manual_seed(0)
    assert detect([torch.ones(256, 256, 3)]).score == 0
    assert detect([torch.rand(32, 32, 3, generator=g)]).score == 0
    assert detect([]).score == 0
    scores = [detect([torch.rand(160, 192, 3, generator=g)], (1.0, 0.5)).score for _ in range(10)]
    assert max(scores) < THRESHOLD - 1
