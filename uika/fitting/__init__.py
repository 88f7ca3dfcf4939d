"""From photos to pixel-wise facial correspondence (paper section 3.1)."""

from uika.fitting.fit import Fit, fit_photos
from uika.fitting.landmarks import LandmarkFit, fit_landmarks
from uika.fitting.pixel_correspondence import pixel_uv
from uika.fitting.surface_marks import SurfaceMarks

__all__ = ["Fit", "LandmarkFit", "SurfaceMarks", "fit_landmarks", "fit_photos", "pixel_uv"]
