"""Photos in: reading, face detection, cropping and matting."""

from uika.photo.error import PhotoError
from uika.photo.parts import head_matte
from uika.photo.preparation import Photo, prepare

__all__ = ["Photo", "PhotoError", "head_matte", "prepare"]
