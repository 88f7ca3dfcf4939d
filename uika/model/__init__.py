"""The reconstruction network: photos and their UV correspondence in, canonical Gaussians out."""

from uika.model.checkpoint import CheckpointError, build, load_checkpoint, save_checkpoint
from uika.model.config import (
    ESTIMATORS,
    PRESETS,
    BackboneConfig,
    EstimatorConfig,
    GaussianConfig,
    ModelConfig,
    UvConfig,
)
from uika.model.estimator import Estimator
from uika.model.gaussians import CanonicalGaussians, SurfaceTexels, multiply_quaternions
from uika.model.reconstructor import Observation, Reconstructor

__all__ = [
    "ESTIMATORS",
    "PRESETS",
    "BackboneConfig",
    "CanonicalGaussians",
    "CheckpointError",
    "Estimator",
    "EstimatorConfig",
    "GaussianConfig",
    "ModelConfig",
    "Observation",
    "Reconstructor",
    "SurfaceTexels",
    "UvConfig",
    "build",
    "load_checkpoint",
    "multiply_quaternions",
    "save_checkpoint",
]
