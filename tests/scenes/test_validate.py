import os
from pathlib import Path

import numpy as np
import pytest

from benchmarks.scene_validation import flame_head
from scenes.validation.__main__ import main, validate
from scenes.validation.gradients import GradientReport
from scenes.validation.report import write_report
from scenes.validation.views import LIMITS, ViewReport, depth_normals
from uika.head import load_head, look_at

BUILT_IN = pytest.mark.skipif("UIKA_HEAD" in os.environ, reason="skipped: another head is chosen")


@BUILT_IN
@pytest.mark.parametrize("bust", [False, True])
def test_splats_of_the_built_in_head_agree_with_mitsuba(bust: bool) -> None:
    head = load_head() if bust else load_head().without_bust
    reports, gradients, pictures = validate(head, 1, ((20.0, 5.0),))
    assert [report.bust for report in reports] == [bust]
    assert [report.failures() for report in reports] == [[]]
    assert gradients.passed(), gradients
    assert pictures[0][1].shape[1] == 3 * pictures[0][1].shape[0]


def test_the_report_says_what_fails(tmp_path: Path) -> None:
    good = ViewReport("head", 0, 0, mask_iou=0.99, depth_mm=0.3, normal_degrees=4, uv=0.001, psnr=30)
    bad = ViewReport("head", 1, 0, mask_iou=0.9, depth_mm=0.3, normal_degrees=4, uv=0.1, psnr=float("nan"))
    gradients = GradientReport((1.0, 2.0, -1.0), (1.1, 2.2, -1.1))
    assert bad.failures() == ["mask_iou", "uv", "psnr"]
    picture = [("view", np.zeros((4, 12, 3)))]
    assert write_report(tmp_path, [([good], gradients, picture)])
    assert "passed" in (tmp_path / "index.html").read_text() and (tmp_path / "view_0_00.png").exists()
    assert not write_report(tmp_path, [([good, bad], gradients, picture)])
    assert "failed" in (tmp_path / "index.html").read_text()
    reversed_ = GradientReport((1.0, 2.0, 1.0), (1.1, 2.2, -1.1))
    assert not reversed_.passed() and not write_report(tmp_path, [([good], reversed_, picture)])
    assert set(LIMITS) <= set(ViewReport.__dataclass_fields__)


def test_normals_of_a_tilted_plane() -> None:
    camera = look_at(30, distance=1.0, size=32)
    K, viewmat = camera.K.double().numpy(), camera.viewmat.double().numpy()
    y, x = np.mgrid[:32, :32] + 0.5
    rays = np.stack(((x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)), -1)
    normal = viewmat[:3, :3] @ np.array([0.0, 0.0, 1.0])
    depth = (viewmat[:3, 3] @ normal) / (rays @ normal)
    found = depth_normals(depth, camera)[1:-1, 1:-1]
    np.testing.assert_allclose(np.abs(found), np.broadcast_to([0, 0, 1.0], found.shape), atol=1e-6)


@BUILT_IN
@pytest.mark.slow
def test_the_command_writes_a_report(tmp_path: Path) -> None:
    assert main(["-o", str(tmp_path / "report"), "--quick"]) == 0
    assert len(list((tmp_path / "report").glob("*.png"))) == 12


@pytest.mark.slow
def test_a_bust_glued_to_a_flame_head_agrees_with_mitsuba(tmp_path: Path) -> None:
    reports, _, _ = validate(flame_head(tmp_path), 1, ((20.0, 5.0), (-80.0, -10.0)))
    assert [report.bust for report in reports] == [True, True]
    assert [report.failures() for report in reports] == [[], []]
