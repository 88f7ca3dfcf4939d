"""Scenes from photos with known cameras: reading data sets, training splats, and going on where a run was stopped."""

from .captures import Capture, Photo
from .config import TrainConfig
from .datasets import open_capture
from .loop import Progress, train

__all__ = ["Capture", "Photo", "Progress", "TrainConfig", "open_capture", "train"]
