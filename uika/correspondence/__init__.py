"""From photos to pixel-wise facial correspondence (paper section 3.1)."""

from uika.correspondence.fit import Fit, fit_photos
from uika.correspondence.landmarks import LandmarkFit, fit_landmarks
from uika.correspondence.pixels import pixel_uv

__all__ = ["Fit", "LandmarkFit", "fit_landmarks", "fit_photos", "pixel_uv"]
