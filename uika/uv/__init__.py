"""Colours of photo pixels carried into the UV atlas: reprojection, aggregation over views, filling of unseen texels."""

from uika.uv.aggregation import Aggregate, aggregate, pool
from uika.uv.filling import diffuse, fill
from uika.uv.holes import close_gaps, close_holes
from uika.uv.mirroring import mirror_preference
from uika.uv.reprojection import Sums, accumulate, accumulate_sizes, reproject, view_images

__all__ = [
    "Aggregate",
    "Sums",
    "accumulate",
    "accumulate_sizes",
    "aggregate",
    "close_gaps",
    "close_holes",
    "diffuse",
    "fill",
    "mirror_preference",
    "pool",
    "reproject",
    "view_images",
]
