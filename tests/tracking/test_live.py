"""A face is followed picture by picture, as from a camera."""

from pathlib import Path

import pytest
import torch

from tests.filmed import FPS
from uika.head import HeadModel, rodrigues
from uika.photo.networks import follow_meshes
from uika.tracking import FaceFollower, VideoError, video_frames
from uika.tracking.live import LEARNING_FRAMES
from uika.viewer import CameraFace
from uika.viewer import camera as camera_module


def test_follower_learns_and_then_turns_as_the_face_does(acted: tuple[Path, torch.Tensor], head: HeadModel) -> None:
    path, yaw = acted
    follower, found, truth, opened = FaceFollower(head), [], [], []
    jaw = head.expression_names.index("jawOpen")
    for index, (picture, landmarks) in enumerate(follow_meshes(video_frames(path))):
        if landmarks is None:
            continue
        pose = follower.see(landmarks, (picture.shape[1], picture.shape[0]), index / FPS)
        assert follower.ready == (pose is not None)
        if pose is None:
            continue
        assert all(bool(torch.isfinite(value).all()) for value in (pose.expression, pose.neck, pose.translation))
        turned = rodrigues(pose.neck[None])[0]
        found.append(torch.atan2(turned[0, 2], turned[2, 2]))
        truth.append(yaw[index])
        opened.append(float(pose.expression[jaw]))
    assert len(found) >= len(yaw) - LEARNING_FRAMES - 8
    turns = torch.stack((torch.stack(found), torch.stack(truth)))
    assert float(torch.corrcoef(turns)[0, 1]) > 0.95
    assert float(torch.rad2deg((turns[0] - turns[1]).abs()).median()) < 8.0
    assert float(pose.translation.norm()) < 0.1  # metres from where it began


def test_camera_thread_hands_out_each_pose_once(
    acted: tuple[Path, torch.Tensor], head: HeadModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    cv2 = pytest.importorskip("cv2", reason="no OpenCV: install the extra 'photo'")
    monkeypatch.setattr(
        camera_module, "_opened", lambda number: cv2.VideoCapture(str(acted[0]))
    )  # for want of a camera
    face = CameraFace(0, head)
    face._thread.join(60)  # until the file ends
    assert face.newest() is not None and face.newest() is None
    assert face.status == "camera 0: gives no more pictures"
    face.stop()


def test_missing_camera_is_one_sentence(head: HeadModel) -> None:
    pytest.importorskip("cv2", reason="no OpenCV: install the extra 'photo'")
    with pytest.raises(VideoError, match="camera 97: cannot be opened"):
        CameraFace(97, head)
