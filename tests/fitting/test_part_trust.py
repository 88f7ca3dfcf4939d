"""Trust in pixels at lids and lips."""

import torch

from uika.fitting.part_trust import INNER_LIPS, LEFT_EYE, RIGHT_EYE, lid_doubt, opening_trust
from uika.fitting.teeth import teeth_offset
from uika.head import HeadParameters, load_head, pose_vertices
from uika.head.mesh_parts import upper_teeth
from uika.motion.presets import expression_vector

SIZE = 128


def test_open_lids_are_doubted_where_they_are_folded_and_shut_ones_are_not() -> None:
    head = load_head()
    rest = HeadParameters.zeros(head)
    none = torch.zeros_like(head.template)
    open_, shut = (
        lid_doubt(head, rest.replace(expression=expression_vector(head, {"eyeBlink": blink})), none)
        for blink in (0.0, 1.0)
    )
    assert open_.max() > 0.9
    assert shut.max() < 0.35
    assert open_[head.masks["eyes"] == 0].max() == 0


def ellipse(middle: tuple[float, float], width: float, height: float, count: int) -> torch.Tensor:
    turn = torch.arange(count) / count * 2 * torch.pi
    return torch.stack((middle[0] + width * turn.cos(), middle[1] + height * turn.sin()), -1)


def landmarks(mouth_height: float) -> torch.Tensor:
    marks = torch.zeros(478, 2)
    marks[list(RIGHT_EYE)] = ellipse((40, 40), -14, 8, len(RIGHT_EYE))
    marks[list(LEFT_EYE)] = ellipse((88, 40), 14, 8, len(LEFT_EYE))
    marks[list(INNER_LIPS)] = ellipse((64, 90), 20, mouth_height, len(INNER_LIPS))
    return marks


def test_parts_must_agree_with_the_landmarks() -> None:
    nothing, all_ = torch.zeros(SIZE, SIZE), torch.ones(SIZE, SIZE)
    skin = opening_trust(landmarks(10), SIZE, nothing, nothing)
    assert skin[40, 40] == 0 and skin[90, 64] == 0 and skin[20, 64] == 1
    assert skin[40, 26] == 1  # the lid's rim, where the lashes are, stays
    balls = opening_trust(landmarks(10), SIZE, all_, nothing)
    assert balls[40, 40] == 1 and balls[20, 64] == 0
    teeth = opening_trust(landmarks(10), SIZE, nothing, all_)
    assert teeth[90, 64] == 1 and teeth[110, 64] == 0


def test_lips_may_lie_a_little_apart() -> None:
    marks, nothing = landmarks(10), torch.zeros(SIZE, SIZE)
    rim = opening_trust(marks, SIZE, nothing, nothing)[90 - 10 : 90 + 10, 64]
    assert rim[0] == 1 and rim[10] == 0  # skin of the fit just inside the landmarks' lips, and in their middle
    teeth = opening_trust(marks, SIZE, nothing, nothing + 1)[:, 64]
    assert teeth[90 + 11] == 1 and teeth[90 + 15] == 0  # teeth of the fit just below them, and far below


def test_shut_lips_hide_nothing() -> None:
    skin = opening_trust(landmarks(0.5), SIZE, torch.zeros(SIZE, SIZE), torch.zeros(SIZE, SIZE))
    assert skin[88:93, 50:78].min() == 1


def test_teeth_stand_behind_the_lips_and_show_when_they_part() -> None:
    head = load_head()
    offset = teeth_offset(head)
    assert offset[head.masks["teeth"] < 0.5].abs().max() == 0
    rest = HeadParameters.zeros(head)
    upper = upper_teeth(head)
    at = int((head.landmark_ids == 13).nonzero()[0])
    lip = head.landmarks(pose_vertices(head, rest))[at]
    teeth = pose_vertices(head, rest, offset)[upper]
    assert 0.002 < float(lip[1] - teeth[:, 1].min()) < 0.006
    assert 0.003 < float(lip[2] - teeth[:, 2].max()) < 0.009
