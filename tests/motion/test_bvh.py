"""BVH files: what is written is read back, and heads of other skeletons turn as their joints say."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.heads import sphere_head
from uika.head import load_head, rodrigues
from uika.motion import MotionError, read_bvh, read_motion, write_bvh, write_motion
from uika.motion.presets import get_motion

# A body that is turned 90 degrees to one side, with a head that nods by 0, 10 and 20 degrees.
BODY = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT mixamorig:Spine
  {
    OFFSET 0 10 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT mixamorig:Head
    {
      OFFSET 0 40 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      End Site
      {
        OFFSET 0 10 0
      }
    }
    JOINT LeftArm
    {
      OFFSET 10 30 0
      CHANNELS 1 Xrotation
    }
  }
}
MOTION
Frames: 3
Frame Time: 0.04
5 90 1 0 0 90 0 0 0 0 0 0 77
5 90 1 0 0 90 0 0 0 0 10 0 77
5 90 1 0 0 90 0 0 0 0 20 0 77
"""


def test_a_motion_is_read_back(tmp_path: Path) -> None:
    head = load_head()
    talk = get_motion("talk", head, 23.976)
    noise = torch.Generator().manual_seed(0)
    turn = 0.4 * torch.randn(len(talk), 3, generator=noise)
    turn[0] = 0
    write_bvh(replace(talk, rotation=turn), tmp_path / "a.bvh")
    found = read_motion(tmp_path / "a.bvh", head)
    assert found.fps == pytest.approx(23.976, abs=1e-4) and len(found) == len(talk)
    assert (rodrigues(found.neck) - rodrigues(turn) @ rodrigues(talk.neck)).abs().max() < 1e-5
    assert not found.expression.any()


def test_a_body_turns_the_head_by_what_its_joints_do(tmp_path: Path) -> None:
    (tmp_path / "body.bvh").write_text(BODY)
    found = read_bvh(tmp_path / "body.bvh")
    assert found.fps == pytest.approx(25)
    assert torch.allclose(
        found.neck, torch.tensor([[0, 0, 0], [np.pi / 18, 0, 0], [np.pi / 9, 0, 0]]).float(), atol=1e-6
    )


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "HIERARCHY"),
        (BODY.replace("mixamorig:Head", "Skullcap"), "no joint named as a head"),
        (BODY.replace("Frames: 3", "Frames: 4"), "promises 4 frames and holds 3"),
        (BODY.replace("0 0 20 0 77", "0 0 20 0"), "13 finite numbers"),
        (BODY.replace("0 0 20 0 77", "0 0 nan 0 77"), "finite numbers"),
        (BODY.replace("0.04", "0"), "no frame time"),
        (BODY.replace("0.04", "x"), "cannot be read as BVH"),
        (BODY.replace("CHANNELS 1", "CHANNELS many"), "cannot be read as BVH"),
    ],
)
def test_damaged_files_are_refused_by_name(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "bad.bvh").write_text(text)
    with pytest.raises(MotionError, match=r"bad\.bvh: .*" + says):
        read_bvh(tmp_path / "bad.bvh")


def test_every_format_comes_out(tmp_path: Path) -> None:
    head = load_head()
    talk = get_motion("talk", head)
    for name in ("a.npz", "a.csv", "a.json"):
        write_motion(talk, tmp_path / name, head)
        assert (read_motion(tmp_path / name, head).expression - talk.expression).abs().max() < 1e-5
    with pytest.raises(MotionError, match="motions of a FLAME head"):
        write_motion(talk, tmp_path / "flame_param.npz", head)
    with pytest.raises(MotionError, match=r"must end in \.npz, \.csv"):
        write_motion(talk, tmp_path / "a.fbx", head)
    small = sphere_head()
    still = get_motion("orbit", small)
    write_motion(still, tmp_path / "flame_param.npz", small)
    assert len(read_motion(tmp_path / "flame_param.npz", small)) == len(still)
