import numpy as np
import pytest
import torch

from tests.heads import sphere_head
from uika import HeadModel, Motion, MotionError, get_motion, load_head, load_motion
from uika.motion.presets import EXPRESSIONS, MOTIONS, expression_vector


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


@pytest.fixture(scope="module")
def small() -> HeadModel:
    return sphere_head()


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("fps", [25.0, 50.0])
def test_built_in_motions_are_smooth_and_in_range(head, name, fps):
    motion = get_motion(name, head, fps)
    assert motion.fps == fps and len(motion) >= 48 * fps / 25
    assert motion.expression.min() >= 0 and motion.expression.max() <= 1
    limits = {"expression": 0.5, "neck": 0.02, "eyes": 0.12, "yaw": 4.0, "pitch": 1.1}
    for field, tensor in motion.tensors().items():
        step = tensor.diff(dim=0).abs().max()
        assert step <= limits.get(field, 0.0) * 25 / fps + 1e-6, (field, step)
        # What is shown again and again must not jump where it starts over.
        assert (tensor[0] - tensor[-1]).abs().max() <= limits.get(field, 0.0), field
    assert torch.equal(get_motion(name, head, fps).expression, motion.expression)


def test_talk_opens_and_closes_the_mouth_blinks_and_looks_around(head):
    motion = get_motion("talk", head)
    jaw = motion.expression[:, head.expression_names.index("jawOpen")]
    assert 0.3 < jaw.max() < 0.7 and jaw.min() < 0.05
    turns = (jaw.diff().sign().diff().abs() > 0).sum()
    assert turns >= 10
    blinks = motion.expression[:, [head.expression_names.index(f"eyeBlink{side}") for side in ("Left", "Right")]]
    assert torch.equal(blinks[:, 0], blinks[:, 1])
    assert ((blinks[1:, 0] > 0.8) & (blinks[:-1, 0] <= 0.8)).sum() == 2
    assert torch.equal(motion.eyes[:, :3], motion.eyes[:, 3:])
    assert motion.eyes.amax() > 0.1 and motion.eyes.amin() < -0.1
    assert 0.02 < motion.neck.abs().max() < 0.2


def test_expressions_pass_through_every_face_and_rest(head):
    motion = get_motion("expressions", head)
    for actions in EXPRESSIONS.values():
        target = expression_vector(head, actions)
        assert target.count_nonzero() >= 3
        assert (motion.expression - target).abs().amax(1).min() < 1e-6
    assert (motion.expression.amax(1) == 0).sum() >= len(EXPRESSIONS)


def test_every_named_action_exists_in_the_built_in_head(head):
    for actions in EXPRESSIONS.values():
        for name in actions:
            assert {name, f"{name}Left", f"{name}Right"} & set(head.expression_names), name


def test_orbit_moves_only_the_camera(head):
    motion = get_motion("orbit", head)
    assert motion.yaw is not None and motion.yaw.max() > 40 and motion.yaw.min() < -40
    assert all(not value.any() for name, value in motion.tensors().items() if name not in ("yaw", "pitch"))


def test_parameters_carry_the_identity(head):
    motion = get_motion("talk", head)
    identity = torch.randn(len(head.identity_basis), generator=torch.Generator().manual_seed(0))
    params = motion.parameters(identity)
    assert params.batch_shape == (len(motion),)
    assert torch.equal(params[7].identity, identity) and torch.equal(params[7].expression, motion.expression[7])


def _write(path, **arrays):
    np.savez(path, **arrays)
    return path


def test_motion_file_is_read_by_name_and_resampled(small, tmp_path):
    path = _write(
        tmp_path / "m.npz",
        fps=10,
        expression=np.linspace(0, 1, 11)[:, None],
        expression_names=np.array(["action2"]),
        yaw=np.arange(11.0),
    )
    motion = load_motion(path, small)
    assert motion.expression.shape == (11, 3) and not motion.expression[:, :2].any()
    assert motion.neck.shape == (11, 3) and not motion.neck.any()
    double = get_motion(str(path), small, 20.0)
    assert len(double) == 22
    torch.testing.assert_close(double.expression[5, 2], torch.tensor(0.25))
    torch.testing.assert_close(double.yaw[:4], torch.tensor([0.0, 0.5, 1.0, 1.5]))


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"expression": np.zeros((4, 3))}, "fps"),
        ({"fps": 25}, "at least one array"),
        ({"fps": 0, "expression": np.zeros((4, 3))}, "frames per second"),
        ({"fps": np.nan, "expression": np.zeros((4, 3))}, "frames per second"),
        ({"fps": 25, "expression": np.zeros((4, 5))}, "columns"),
        ({"fps": 25, "expression": np.zeros((0, 3))}, "frames"),
        ({"fps": 25, "expression": np.zeros((4, 3)), "neck": np.zeros((5, 3))}, "neck"),
        ({"fps": 25, "expression": np.full((4, 3), np.inf)}, "finite"),
        ({"fps": 25, "expression": np.array(["a"] * 3)}, "numbers"),
        ({"fps": 25, "jaws": np.zeros((4, 3))}, "jaws"),
        ({"fps": 25, "expression": np.zeros((4, 1)), "expression_names": np.array(["smile"])}, "smile"),
        ({"fps": 25, "expression": np.zeros((4, 2)), "expression_names": np.array(["action0"])}, "names"),
        ({"fps": 25, "expression": np.array([[{"a": 1}]], dtype=object)}, "plain arrays"),
    ],
)
def test_unusable_motion_files_are_refused(small, tmp_path, arrays, says):
    path = _write(tmp_path / "bad.npz", **arrays)
    with pytest.raises(MotionError, match=r"bad\.npz: ") as caught:
        load_motion(path, small)
    assert says in str(caught.value)


def test_damaged_and_missing_motion_files_are_refused(small, tmp_path):
    path = _write(tmp_path / "cut.npz", fps=25, expression=np.zeros((40, 3)))
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(MotionError, match=r"cut\.npz"):
        load_motion(path, small)
    with pytest.raises(MotionError, match="no such motion file"):
        get_motion(str(tmp_path / "none.npz"), small)
    with pytest.raises(MotionError, match="orbit, talk, expressions"):
        get_motion("dance", small)
    for fps in (0.0, -1.0, float("nan"), 1000.0):
        with pytest.raises(MotionError, match="fps"):
            get_motion("talk", small, fps)


def test_motion_refuses_tensors_that_do_not_fit(small):
    motion = get_motion("orbit", small)
    with pytest.raises(MotionError, match="eyes"):
        Motion(**{**motion.tensors(), "eyes": torch.zeros(3, 6)}, fps=25.0)
