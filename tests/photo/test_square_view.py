import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from tests.heads import PARITY
from uika.errors import UikaError
from uika.photo.square_view import area_resize, prepare_reference, prepare_view, reference_box

FIXTURE = PARITY / "image_prep.safetensors"


def disc(height: int, width: int, radius: float) -> np.ndarray:
    y, x = np.mgrid[:height, :width] + 0.5
    return (x - width / 2) ** 2 + (y - height / 2) ** 2 < radius**2


@pytest.mark.skipif(not FIXTURE.exists(), reason="skipped: the parity fixtures are not there")
def test_both_branches_match_the_released_code() -> None:
    data = load_file(FIXTURE)
    image, alpha = data["in/rgb"].numpy(), data["in/alpha"].numpy()
    view = prepare_view(image, alpha > 0.5, torch.tensor([[300.0, 0, 60], [0, 300, 45], [0, 0, 1]]), 64, 0.5)
    assert view.offset == int(data["out/train_offset"][0])
    torch.testing.assert_close(view.image.permute(1, 2, 0), data["out/train_rgb"], atol=1e-6, rtol=0)
    torch.testing.assert_close(view.mask, data["out/train_mask"], atol=1e-6, rtol=0)
    torch.testing.assert_close(view.K, data["out/train_K"][:3, :3], atol=1e-4, rtol=0)
    assert reference_box(tuple(data["in/bbox"].tolist()), 120, 90) == tuple(data["out/bbox_clipped"].tolist())
    rgb, mask = prepare_reference(image, alpha, 64)
    torch.testing.assert_close(rgb, data["out/image"][0], atol=1e-6, rtol=0)
    torch.testing.assert_close(mask, data["out/mask"][0, 0], atol=1e-6, rtol=0)


@pytest.mark.parametrize(("source", "target"), [(74, 64), (40, 64), (64, 64), (100, 37), (8, 64)])
def test_area_resize_matches_opencv(source: int, target: int) -> None:
    cv2 = pytest.importorskip("cv2", reason="skipped: OpenCV is not installed")
    image = np.random.default_rng(0).random((source, source, 3)).astype(np.float32)
    expected = cv2.resize(image, (target, target), interpolation=cv2.INTER_AREA)
    np.testing.assert_allclose(area_resize(image, target), expected, atol=1e-6)


def test_the_crop_keeps_pixels_and_camera_together() -> None:
    mask = disc(80, 100, 20)
    image = np.zeros((80, 100, 3), np.float32)
    image[40:42, 55:57] = 1  # 6 pixels right of the centre, 1 below
    view = prepare_view(image, mask, torch.tensor([[200.0, 0, 50], [0, 200, 40], [0, 0, 1]]), 120, 0.0)
    rows, columns = np.nonzero(view.image[0].numpy() > 0.5)
    ray = (torch.tensor([columns.mean() + 0.5, rows.mean() + 0.5]) - view.K[:2, 2]) / view.K[0, 0]
    torch.testing.assert_close(ray, torch.tensor([6 / 200, 1 / 200], dtype=ray.dtype), atol=1e-3, rtol=0)
    wide = prepare_view(image, mask, torch.tensor([[200.0, 0, 50], [0, 200, 40], [0, 0, 1]]), 120, 0.0, enlarge=1.2)
    assert wide.offset < view.offset


def test_bad_views_are_refused() -> None:
    K = torch.tensor([[100.0, 0, 20], [0, 100, 20], [0, 0, 1]])
    with pytest.raises(UikaError, match="must agree"):
        prepare_view(np.zeros((40, 40, 3)), disc(40, 41, 9), K)
    with pytest.raises(UikaError, match="empty"):
        prepare_view(np.zeros((40, 40, 3)), np.zeros((40, 40), bool), K)
    with pytest.raises(UikaError, match="principal point"):
        prepare_view(np.zeros((40, 40, 3)), disc(40, 40, 9), K + torch.tensor([[0, 0, 5.0], [0, 0, 0], [0, 0, 0]]))
