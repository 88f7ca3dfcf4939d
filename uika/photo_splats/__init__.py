"""What photos show of a person outside the fitted surface, as splats: strands, curls, buns, collars, hats."""

from uika.photo_splats.photo_splats import LIMIT, PhotoView, frontal, with_photo_splats

__all__ = ["LIMIT", "PhotoView", "frontal", "with_photo_splats"]
