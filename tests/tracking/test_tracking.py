"""Videos drive heads."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.filmed import FPS, GAP
from tests.flame_files import flame_arrays
from uika.cli import main
from uika.head import HeadModel, pose_vertices, rodrigues
from uika.head_import.flame_file import read_flame
from uika.head_import.landmark_embedding import nearest
from uika.io.video import write_video
from uika.motion import load_motion, read_motion
from uika.motion.presets import get_motion
from uika.motion.retargeting import transfer
from uika.tracking import VideoError, track_video


def test_track_command(acted: tuple[Path, torch.Tensor], head: HeadModel, tmp_path: Path, capsys) -> None:
    video, yaw = acted
    output, preview = tmp_path / "motion.npz", tmp_path / "preview.mp4"
    assert main(["track", str(video), "-o", str(output), "--preview", str(preview)]) == 0
    said = capsys.readouterr().out
    assert f"no face in {len(GAP)} frames, filled in: {GAP[0]}-{GAP[-1]}" in said
    assert preview.stat().st_size > 10_000
    motion = load_motion(output, head)
    assert (len(motion), motion.fps) == (len(yaw), FPS)
    turned = rodrigues(motion.neck)
    found = torch.atan2(turned[:, 0, 2], turned[:, 2, 2])
    assert float(torch.corrcoef(torch.stack((found, yaw)))[0, 1]) > 0.97
    assert float(torch.rad2deg((found - yaw).abs()).median()) < 6.0
    jaw = motion.expression[:, head.expression_names.index("jawOpen")]
    assert float(jaw[4:8].mean()) > float(jaw[[0, 1, 15, 16, 17]].mean()) + 0.1


def test_videos_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    with pytest.raises(VideoError, match=r"none\.mp4: no such video"):
        track_video(tmp_path / "none.mp4")
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(VideoError, match=r"text\.mp4: cannot be read as a video"):
        track_video(tmp_path / "text.mp4")
    write_video(tmp_path / "blank.mp4", [torch.ones(64, 64, 3)] * 3, FPS)
    with pytest.raises(VideoError, match=r"blank\.mp4: shows no face in any of its 3 frames"):
        track_video(tmp_path / "blank.mp4")


@pytest.fixture(scope="module")
def flame(head: HeadModel, tmp_path_factory: pytest.TempPathFactory) -> HeadModel:
    path = tmp_path_factory.mktemp("flame") / "model.npz"
    np.savez(path, **flame_arrays())
    bare = read_flame(path)
    triangle, mix, _ = nearest(head.landmarks(head.template), bare.template, bare.faces)
    return replace(
        bare,
        landmark_faces=triangle,
        landmark_barycentrics=mix,
        landmark_ids=head.landmark_ids,
        landmark_weights=head.landmark_weights,
        masks={},
    )


def test_expressions_cross_from_actions_to_flame_and_back(head: HeadModel, flame: HeadModel) -> None:
    motion = get_motion("talk", head, 10.0)
    there = transfer(motion, head, flame)
    assert there.expression.shape == (len(motion), 100)
    opened = motion.expression[:, head.expression_names.index("jawOpen")]
    assert float(torch.corrcoef(torch.stack((there.jaw[:, 0], opened)))[0, 1]) > 0.9
    back = transfer(there, flame, head)
    params = [m.parameters(torch.zeros(100)).replace(neck=torch.zeros(len(m), 3)) for m in (motion, back)]
    marks = [head.landmarks(pose_vertices(head, p)) for p in params]
    rest = head.landmarks(head.template)
    assert float((marks[0] - marks[1]).norm(dim=-1).mean()) < 0.3 * float((marks[0] - rest).norm(dim=-1).mean())
    assert float(back.expression.min()) >= 0
    assert float(back.expression.max()) <= 1


def test_flame_parameters_move_the_built_in_head(head: HeadModel, flame: HeadModel, tmp_path: Path) -> None:
    jaw = np.zeros((4, 3), np.float32)
    jaw[:, 0] = (0.0, 0.1, 0.2, 0.3)
    np.savez(tmp_path / "param.npz", expr=np.zeros((4, 100), np.float32), jaw_pose=jaw)
    motion = read_motion(tmp_path / "param.npz", head, flame)
    opened = motion.expression[:, head.expression_names.index("jawOpen")]
    assert bool((opened.diff() > 0.05).all())
