"""Colours of photo pixels carried into the UV atlas: reprojection, aggregation over views, filling of unseen texels."""

from uika.uv.aggregate import Aggregate, aggregate
from uika.uv.fill import diffuse, fill
from uika.uv.holes import close_holes
from uika.uv.reproject import Sums, accumulate, reproject

__all__ = ["Aggregate", "Sums", "accumulate", "aggregate", "close_holes", "diffuse", "fill", "reproject"]
