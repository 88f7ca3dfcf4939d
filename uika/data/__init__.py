"""Training data: captures on disk, shards, and synthetic people; importing it loads no renderer."""

from uika.data.capture import Capture, open_capture
from uika.data.quality import WarpingErrors, warping_errors
from uika.data.sample import DataError, Sample
from uika.data.shards import read_shard, shard_samples, write_shard
from uika.data.synthesis import Synthesis, SynthesisReport, synthesize

__all__ = [
    "Capture",
    "DataError",
    "Sample",
    "Synthesis",
    "SynthesisReport",
    "WarpingErrors",
    "open_capture",
    "read_shard",
    "shard_samples",
    "synthesize",
    "warping_errors",
    "write_shard",
]
