"""Follow a face while it is being filmed."""

from __future__ import annotations

import math

import numpy as np
import torch

from uika.fitting.frame_fit import fit_frame, start_pose
from uika.fitting.landmarks import eye_distance, fit_landmarks
from uika.head import HeadModel, HeadParameters
from uika.head.axis_angle import Array
from uika.head.landmark_model import FrameModel, Pose, frame_model
from uika.motion.smoothing import MIN_CUTOFF, SPEED_GAIN, OneEuro
from uika.tracking.poses import poses_to_motion

LEARNING_FRAMES = 8  # with a face: the person's shape and the focal length come from these
_LONGEST_STEP = 0.5  # seconds: after a longer pause there is nothing left to smooth


class FaceFollower:
    """The pose of a face, picture by picture; the first pictures only teach it whose face it is."""

    def __init__(self, head: HeadModel) -> None:
        """Start with a face that is not known yet."""
        self._head = head
        self._taught: list[Array] = []
        self._model: FrameModel | None = None
        self._identity = torch.zeros(len(head.identity_basis))
        self._pose: Pose | None = None
        self._start: Pose | None = None
        self._smooth: dict[str, OneEuro] = {}
        self._last = -math.inf

    @property
    def ready(self) -> bool:
        """Whether the face is known."""
        return self._model is not None

    def see(self, landmarks: Array, size: tuple[int, int], seconds: float) -> HeadParameters | None:
        """The smoothed pose of one picture, its place relative to that at first; None while learning.

        Args:
            landmarks: [478,2] of the face mesh, in pixels.
            size: width and height of the picture.
            seconds: when it was taken, on any clock.
        """
        target = landmarks - np.array(size) / 2
        if self._model is None:
            self._taught.append(target)
            if len(self._taught) < LEARNING_FRAMES:
                return None
            self._learn()
        model, before = self._model, self._pose
        assert model is not None and before is not None
        self._pose = fit_frame(model, target, before)[0]
        self._start = self._pose if self._start is None else self._start
        pair = poses_to_motion((self._start, self._pose), model, self._head, self._identity, 1.0)
        step, self._last = seconds - self._last, seconds
        values = {name: value[1] for name, value in pair.tensors().items()}
        values["translation"] = pair.translation[1] - pair.translation[0]
        if step > _LONGEST_STEP:
            self._smooth = {name: OneEuro(value, MIN_CUTOFF, SPEED_GAIN[name]) for name, value in values.items()}
        calm = {name: self._smooth[name].step(value, max(step, 1e-3)) for name, value in values.items()}
        return HeadParameters.zeros(self._head).replace(**calm)

    def _learn(self) -> None:
        fit = fit_landmarks(torch.tensor(np.stack(self._taught)), self._head, 0)
        focal, unit = float(fit.focal.median()), eye_distance(self._head)
        self._model, self._identity = frame_model(self._head, fit.identity, focal, unit), fit.identity
        last = start_pose(self._model, fit, len(self._taught) - 1)
        self._pose = fit_frame(self._model, self._taught[-1], last, stillness=0.0)[0]
        self._taught = []
