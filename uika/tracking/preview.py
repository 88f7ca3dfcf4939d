"""A video that shows a tracked video beside the head that follows it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from uika.head import Camera, HeadModel, HeadParameters, pose_vertices, project
from uika.head.face_paint import paint, shade
from uika.head.landmark_model import Pose
from uika.io.progress import counted
from uika.io.video import write_video
from uika.tracking.decode import video_frames
from uika.tracking.track import Track

HEIGHT = 384  # pixels
DOT = (0.1, 1.0, 0.2)


def write_preview(track: Track, source: str | Path, target: str | Path, head: HeadModel, progress: bool = False) -> int:
    """Write an `.mp4`: each frame with the fitted landmarks, and beside it the painted head in the same pose.

    Args:
        track: what was found in the video.
        source: the video.
        target: the file to write.
        head: the head model it was tracked with.
        progress: whether to show a progress bar on stderr.

    Returns:
        The number of frames.
    """
    colours = paint(head)
    frames = counted(_repeated(video_frames(source), track.frames), progress, len(track.poses), "preview")
    pairs = zip(frames, track.poses, strict=False)
    return write_video(target, _pictures(track, pairs, head, colours), track.motion.fps)


def _repeated(frames: Iterable[np.ndarray], wanted: Sequence[int]) -> Iterator[np.ndarray]:
    """The frames with the `wanted` numbers, which rise; one wanted twice comes twice."""
    place = 0
    for index, frame in enumerate(frames):
        while place < len(wanted) and wanted[place] == index:
            yield frame
            place += 1


def tracked_camera(track: Track, pose: Pose, height: int) -> Camera:
    """The camera that shows the unposed head as the frame shows the face, at `height` pixels."""
    width = 2 * round(height * track.size[0] / track.size[1] / 2)
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.tensor(pose.rotation)
    viewmat[:3, 3] = torch.tensor(pose.translation)
    K = torch.tensor([[track.focal, 0, track.size[0] / 2], [0, track.focal, track.size[1] / 2], [0, 0, 1]])
    return Camera(viewmat, K.float(), *track.size).resized(width, height)


def face_parameters(track: Track, index: int, head: HeadModel) -> HeadParameters:
    """Identity, expression, jaw and eyes of a frame, the head unturned; `tracked_camera` carries its pose."""
    motion = track.motion
    return HeadParameters.zeros(head).replace(
        identity=track.identity, expression=motion.expression[index], jaw=motion.jaw[index], eyes=motion.eyes[index]
    )


def _pictures(
    track: Track, pairs: Iterator[tuple[np.ndarray, Pose]], head: HeadModel, colours: Tensor
) -> Iterator[Tensor]:
    for index, (frame, pose) in enumerate(pairs):
        camera = tracked_camera(track, pose, HEIGHT)
        vertices = pose_vertices(head, face_parameters(track, index, head))
        picture = np.asarray(Image.fromarray(frame).resize((camera.width, camera.height), Image.Resampling.BILINEAR))
        left = torch.from_numpy(picture.copy()).float() / 255
        marks = project(head.landmarks(vertices), camera)[0].floor().long()
        inside = ((marks >= 0) & (marks < torch.tensor([camera.width, camera.height]))).all(-1)
        left[marks[inside, 1], marks[inside, 0]] = torch.tensor(DOT)
        right = torch.from_numpy(shade(vertices, head.faces, colours, camera)[0]).float() / 255
        yield torch.cat((left, right), 1)
