import pytest
import torch

from uika.head import Camera, look_at, orbit, project


def test_front_camera_sees_left_of_subject_on_the_right_and_up_on_top() -> None:
    camera = look_at(distance=1.0, focal=500.0, size=(400, 300))
    xy, z = project(torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]), camera)
    torch.testing.assert_close(xy, torch.tensor([[200.0, 150.0], [250.0, 150.0], [200.0, 100.0]]))
    torch.testing.assert_close(z, torch.ones(3))


def test_yaw_and_pitch_move_the_camera_left_and_up() -> None:
    position = look_at(yaw=30, pitch=20, distance=2.0, target=(0.1, 0.2, 0.3)).position - torch.tensor([0.1, 0.2, 0.3])
    assert position[0] > 0.5 and position[1] > 0.5
    assert float(position.norm()) == pytest.approx(2.0, abs=1e-5)


def test_target_stays_in_the_middle_along_an_orbit() -> None:
    target = torch.tensor([[0.05, -0.02, 0.01]])
    cameras = orbit(7, target=target[0], size=128)
    xy, z = project(target, cameras)
    torch.testing.assert_close(xy, torch.full((7, 1, 2), 64.0), atol=1e-3, rtol=0)
    torch.testing.assert_close(z, torch.ones(7, 1))
    one, _ = project(target, cameras[3])
    torch.testing.assert_close(one, xy[3])


def test_resized_camera_scales_pixels() -> None:
    camera = look_at(yaw=20, size=(200, 100))
    points = torch.randn(10, 3) * 0.05
    xy, _ = project(points, camera)
    scaled, _ = project(points, camera.resized(300, 50))
    torch.testing.assert_close(scaled, xy * torch.tensor([1.5, 0.5]))


def test_points_behind_are_finite_and_recognisable() -> None:
    xy, z = project(torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 1.0]]), look_at(distance=1.0))
    assert bool(xy.isfinite().all()) and float(z[0]) < 0 and float(z[1]) == 0


@pytest.mark.parametrize("bad", [{"fov_y": 20.0, "focal": 3.0}, {"pitch": 90.0}, {"distance": 0.0}])
def test_impossible_views_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="look_at"):
        look_at(**bad)  # type: ignore[arg-type]


def test_wrong_matrix_is_named() -> None:
    with pytest.raises(ValueError, match="'K' has shape"):
        Camera(torch.eye(4), torch.eye(4), 8, 8)
