"""The reconstruction network: photos and their UV correspondence in, canonical Gaussians out."""

from uika.canonical.surface import SurfaceTexels
from uika.head.rotations import multiply_quaternions
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
from uika.model.gaussians import CanonicalGaussians
from uika.model.observation import Observation
from uika.model.precision import Precision, compile_blocks, computes_bfloat16
from uika.model.reconstructor import Reconstructor
from uika.model.session import Session
from uika.model.view_features import FeatureCache, Keep, ViewFeatures

__all__ = [
    "ESTIMATORS",
    "PRESETS",
    "BackboneConfig",
    "CanonicalGaussians",
    "CheckpointError",
    "Estimator",
    "EstimatorConfig",
    "FeatureCache",
    "GaussianConfig",
    "Keep",
    "ModelConfig",
    "Observation",
    "Precision",
    "Reconstructor",
    "Session",
    "SurfaceTexels",
    "UvConfig",
    "ViewFeatures",
    "build",
    "compile_blocks",
    "computes_bfloat16",
    "load_checkpoint",
    "multiply_quaternions",
    "save_checkpoint",
]
