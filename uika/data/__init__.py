"""Training data: captures on disk, shards, and synthetic people; importing it loads no renderer."""

from uika.data.capture import Capture, open_capture
from uika.data.prepare import PreparedView, prepare_reference, prepare_view, reference_box
from uika.data.quality import WarpingErrors, warping_errors
from uika.data.sample import DataError, Sample
from uika.data.shards import read_shard, shard_samples, write_shard
from uika.data.synthesis import Synthesis, SynthesisReport, synthesize

__all__ = [
    "Capture",
    "DataError",
    "PreparedView",
    "Sample",
    "Synthesis",
    "SynthesisReport",
    "WarpingErrors",
    "open_capture",
    "prepare_reference",
    "prepare_view",
    "read_shard",
    "reference_box",
    "shard_samples",
    "synthesize",
    "warping_errors",
    "write_shard",
]
