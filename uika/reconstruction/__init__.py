"""Photos to an avatar, in one step or photo by photo."""

from uika.reconstruction.canonical_head import CanonicalHead
from uika.reconstruction.fitted_photos import (
    FittedPhotos,
    PreparedPhoto,
    fit_files,
    fit_prepared,
    photo_light,
    prepare_file,
)
from uika.reconstruction.incremental import GrowingAvatar
from uika.reconstruction.models import LoadedModel, check_loaded, check_model, load_model
from uika.reconstruction.photos_to_avatar import MAX_PHOTOS, Reconstruction, assemble, avatar_from_fit, reconstruct
from uika.reconstruction.report import Report

__all__ = [
    "MAX_PHOTOS",
    "CanonicalHead",
    "FittedPhotos",
    "GrowingAvatar",
    "LoadedModel",
    "PreparedPhoto",
    "Reconstruction",
    "Report",
    "assemble",
    "avatar_from_fit",
    "check_loaded",
    "check_model",
    "fit_files",
    "fit_prepared",
    "load_model",
    "photo_light",
    "prepare_file",
    "reconstruct",
]
