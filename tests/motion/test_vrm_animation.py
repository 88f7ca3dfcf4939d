"""Animations of VRM avatars: heads turn as bones say, whatever the rest pose, and expressions follow."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.vrm_animations import TIMES, written
from uika.errors import UikaWarning
from uika.head import load_head, rodrigues
from uika.head.actions import ARKIT_ACTIONS
from uika.motion import MotionError, read_motion
from uika.motion.vrm_animation import read_vrma


@pytest.mark.parametrize(("rest", "hips", "way"), [(0, 0, "LINEAR"), (25, 0, "LINEAR"), (25, 70, "CUBICSPLINE")])
def test_the_head_turns_beside_its_hips(tmp_path, rest, hips, way):
    motion = read_vrma(written(tmp_path / "a.vrma", rest, hips, way))
    assert len(motion) == 31 and motion.fps == 30
    expected = torch.from_numpy(
        Rotation.from_rotvec(np.outer(np.linspace(0, 40, 31), (0, 1, 0)), degrees=True).as_matrix()
    ).float()
    assert (rodrigues(motion.neck) - expected).abs().max() < 1e-5
    assert torch.rad2deg(motion.eyes[-1]).tolist() == pytest.approx([0, 10, 0, 0, 10, 0], abs=1e-3)


def test_expressions_become_actions_and_are_clamped(tmp_path):
    motion = read_vrma(written(tmp_path / "a.vrma"))

    def of(name: str) -> torch.Tensor:
        return motion.expression[:, ARKIT_ACTIONS.index(name)]

    assert of("eyeBlinkLeft")[15] == 1 and of("eyeBlinkRight")[[0, -1]].tolist() == [0, 0]
    assert of("jawOpen")[[0, 15, 30]].tolist() == pytest.approx([0.25, 0.25, 1.0])
    stepped = read_vrma(written(tmp_path / "b.vrma", way="STEP"))
    assert set(stepped.expression[:, ARKIT_ACTIONS.index("eyeBlinkLeft")].tolist()) == {0.0, 1.0}
    assert set(torch.rad2deg(stepped.neck[:, 1]).round().tolist()) == {0.0, 20.0, 40.0}


def test_a_head_is_moved_by_it(tmp_path):
    head = load_head()
    motion = read_motion(written(tmp_path / "a.vrma"), head)
    assert motion.expression.shape == (31, len(head.expression_names))
    assert motion.expression[15, head.expression_names.index("eyeBlinkLeft")] == 1


def test_what_no_action_bears_is_named(tmp_path):
    with pytest.warns(UikaWarning, match=r"a\.vrma: leaves out expressions .* Tail"):
        read_vrma(written(tmp_path / "a.vrma", strange=True))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"plain": True}, "holds no animation of a VRM avatar"),
        ({"times": TIMES[::-1].copy()}, "times that fall"),
        ({"times": TIMES * 1e5}, "at most 3600"),
        ({"times": TIMES * np.nan}, "not finite"),
        ({"times": TIMES[:2]}, "keys without times"),
        ({"children": [2, 0]}, "their own parents"),
    ],
)
def test_damaged_files_are_named(tmp_path, changes, says):
    with pytest.raises(MotionError, match=rf"a\.vrma: .*{says}"):
        read_vrma(written(tmp_path / "a.vrma", **changes))


def test_cut_or_missing_files_are_named(tmp_path):
    data = written(tmp_path / "a.vrma").read_bytes()
    for size in (0, 11, 40, len(data) // 2, len(data) - 30):
        (tmp_path / "b.vrma").write_bytes(data[:size])
        with pytest.raises(MotionError, match=r"b\.vrma: "):
            read_vrma(tmp_path / "b.vrma")
    with pytest.raises(MotionError, match=r"none\.vrma: no such file"):
        read_vrma(tmp_path / "none.vrma")
