"""Drive a head from a video: landmarks find the face, the person's own colours follow it (see `appearance`)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uika.fitting.bundle_adjustment import bundle
from uika.fitting.frame_fit import fit_frame, start_pose
from uika.fitting.landmarks import LandmarkFit, eye_distance, fit_landmarks
from uika.fitting.photometric import FaceCrop, add_observation, crop_face, make_appearance
from uika.head import HeadModel, load_head
from uika.head.axis_angle import Array
from uika.head.landmark_model import FrameModel, Pose, frame_model
from uika.io.progress import counted
from uika.motion import Motion
from uika.motion.frame_times import even_places, is_even, rate_of
from uika.motion.smoothing import smoothed
from uika.tracking.appearance import BLURS, LANDMARK_PULL, learn_appearance, track_appearance
from uika.tracking.decode import VideoError, decode_ahead, frame_rate
from uika.tracking.eye_region import full_range
from uika.tracking.poses import poses_between, poses_to_motion, without_gaps

# A frame [H,W,3] sRGB and its face mesh [478,2] in pixels -> the face mesh in better places.
PlaceLandmarks = Callable[[NDArray[np.uint8], Array], Array]
IDENTITY_FRAMES = 8  # the first guess of identity and focal length comes from these
KEY_FRAMES = 12  # at least; the person's colours and final identity come from these
MAX_FRAMES = 100_000


@dataclass(frozen=True, eq=False)
class Track:
    """A tracked video of T frames.

    motion: expression, jaw, eyes and the head's rotation and translation as seen from the camera, smoothed.
    identity: [K] the person's. focal: pixels, fixed. poses: as fitted, one for each frame of the motion; those of a
    video whose frames are not evenly spaced lie between its frames. lost: frames of the video without a face, filled in
    between their neighbours. error: mean landmark distance in outer eye-corner distances. seconds: per stage.
    """

    motion: Motion
    identity: Tensor
    focal: float
    poses: tuple[Pose, ...]
    lost: tuple[int, ...]
    error: float
    size: tuple[int, int]  # width and height in pixels
    frames: tuple[int, ...]  # of the video, the one nearest in time to each pose
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Seen:
    landmarks: list[Array | None]
    keys: dict[int, FaceCrop]  # sharp views of some frames
    fps: float
    size: tuple[int, int]
    places: Array | None  # where the frames of the motion lie between those of the video; None if they are the same


def track_video(
    path: str | Path,
    head: HeadModel | None = None,
    *,
    smooth: bool = True,
    progress: bool = False,
    place: PlaceLandmarks | None = None,
) -> Track:
    """Find how the head in a video moves.

    Args:
        path: any video that FFmpeg reads, with one face.
        head: the head model to move; None loads the one that `uika.head.load_head` finds.
        smooth: whether to take jitter out of the motion.
        progress: whether to show progress bars on stderr.
        place: moves the landmarks that were detected in a frame; None leaves them where they are.

    Raises:
        VideoError: the file is missing, unreadable, or shows no face.
    """
    head = load_head() if head is None else head
    seconds: dict[str, float] = {}
    start = time.perf_counter()
    seen = _look(Path(path), progress, place)
    found = [index for index, marks in enumerate(seen.landmarks) if marks is not None]
    if not found:
        raise VideoError(f"{path}: shows no face in any of its {len(seen.landmarks)} frames")
    seconds["landmarks"] = time.perf_counter() - start
    start = time.perf_counter()
    centre = np.array(seen.size) / 2
    targets = {index: marks - centre for index in found if (marks := seen.landmarks[index]) is not None}
    fit = _shared_identity(targets, head)
    focal, unit = float(fit.focal.median()), eye_distance(head)
    model = frame_model(head, fit.identity, focal, unit)
    rough, errors = _by_landmarks(model, targets, start_pose(model, fit, 0))
    seconds["fit"] = time.perf_counter() - start
    start = time.perf_counter()
    blank = make_appearance(head, fit.identity, focal, unit)
    known = {index: rough[index] for index in seen.keys}
    person, known = learn_appearance(blank, model, known, targets, seen.keys)
    shared = bundle(head, person, model, known, seen.keys, targets, LANDMARK_PULL)
    identity = fit.identity.clone()
    identity[: len(shared.offset)] += torch.from_numpy(shared.offset)
    model = frame_model(head, identity, shared.focal, unit)
    person = make_appearance(head, identity, shared.focal, unit)
    for index, pose in shared.poses.items():
        person = add_observation(person, pose, seen.keys[index])
    seconds["identity"] = time.perf_counter() - start
    start = time.perf_counter()
    frames = counted(decode_ahead(Path(path)), progress, len(seen.landmarks), "follow")
    poses = track_appearance(person, model, rough, targets, (frame.grey for frame in frames), centre)
    poses = full_range(model, head.expression_names, poses, targets)
    seconds["follow"] = time.perf_counter() - start
    complete = without_gaps(poses, len(seen.landmarks))
    places = np.arange(len(complete), dtype=np.float64) if seen.places is None else seen.places
    if seen.places is not None:
        complete = poses_between(complete, places)
    motion = poses_to_motion(complete, model, head, identity, seen.fps)
    return Track(
        motion=smoothed(motion) if smooth else motion,
        identity=identity.float(),
        focal=shared.focal,
        poses=tuple(complete),
        lost=tuple(index for index, marks in enumerate(seen.landmarks) if marks is None),
        error=float(np.mean(errors)),
        size=seen.size,
        frames=tuple(places.round().astype(int).tolist()),
        seconds=seconds,
    )


def _look(path: Path, progress: bool, place: PlaceLandmarks | None) -> _Seen:
    """Landmarks of all frames, and views of evenly spread key frames."""
    from uika.photo.networks import follow_meshes
    from uika.photo.trust import turned_by

    landmarks: list[Array | None] = []
    keys: dict[int, FaceCrop] = {}
    greys: list[NDArray[np.uint8]] = []
    times: list[float | None] = []
    stride, size = 1, (0, 0)

    def pictures() -> Iterator[NDArray[np.uint8]]:
        for frame in counted(decode_ahead(path, colour=True), progress, None, "landmarks"):
            greys[:] = [frame.grey]
            times.append(frame.seconds)
            yield frame.rgb

    for index, (image, marks) in enumerate(follow_meshes(pictures())):
        if index >= MAX_FRAMES:
            raise VideoError(f"{path}: has more than {MAX_FRAMES} frames; cut it into parts")
        size = (image.shape[1], image.shape[0])
        if marks is not None and not keys and (degrees := turned_by(image, marks)):
            raise VideoError(f"{path}: its face is not upright; turn the video by {degrees} degrees counterclockwise")
        if marks is not None and place is not None:
            marks = place(image, marks)
        landmarks.append(marks)
        if marks is not None and index % stride == 0:
            keys[index] = crop_face(greys[0], marks, np.array(size) / 2, BLURS[-1][0])
        if len(keys) >= 2 * KEY_FRAMES - 8:
            stride *= 2
            keys = {index: view for index, view in keys.items() if index % stride == 0}
    if not landmarks:
        raise VideoError(f"{path}: has no pictures in it")
    fps, places = _pace(path, times)
    return _Seen(landmarks, keys, fps, size, places)


def _pace(path: Path, times: list[float | None]) -> tuple[float, Array | None]:
    """Frames per second, and where the frames of that rate lie between the video's if those are not evenly spaced."""
    fps = frame_rate(path)
    known = [time for time in times if time is not None]
    if len(known) < 2 or len(known) < len(times):
        return fps, None
    seconds = np.array(known) - known[0]
    if (np.diff(seconds) < 0).any() or seconds[-1] <= 0 or is_even(seconds, fps):
        return fps, None
    fps = rate_of(seconds)
    try:
        return fps, None if is_even(seconds, fps) else even_places(seconds, fps)
    except ValueError as error:
        raise VideoError(f"{path}: {error}; cut it into parts") from error


def _shared_identity(targets: dict[int, Array], head: HeadModel) -> LandmarkFit:
    """A first guess of identity and focal length from evenly spread frames; the first one is among them."""
    marks = list(targets.values())
    step = max(1, len(marks) // IDENTITY_FRAMES)
    return fit_landmarks(torch.tensor(np.stack(marks[::step][: IDENTITY_FRAMES + 1])), head, 0)


def _by_landmarks(model: FrameModel, targets: dict[int, Array], start: Pose) -> tuple[dict[int, Pose], list[float]]:
    poses: dict[int, Pose] = {}
    errors = []
    pose, last = fit_frame(model, next(iter(targets.values())), start, stillness=0.0)[0], None
    for index, target in targets.items():
        jumped = last is not None and index - last > 1
        if jumped:
            pose = _placed(model, pose, target)
        pose, error = fit_frame(model, target, pose)
        poses[index], last = pose, index
        errors.append(error)
    return poses, errors


def _placed(model: FrameModel, pose: Pose, target: Array) -> Pose:
    """The pose moved to where the face shows up again after a gap."""
    depth = pose.translation[2]
    shift = target[model.ids].mean(0) * depth / model.focal - pose.translation[:2]
    return replace(pose, translation=pose.translation + np.array([*shift, 0.0]))
