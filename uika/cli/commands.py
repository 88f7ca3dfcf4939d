"""The commands of the command line; each dataclass is one command's arguments."""

from __future__ import annotations

from uika.cli.animate import Animate
from uika.cli.bench import Bench
from uika.cli.demo import Demo
from uika.cli.doctor import Doctor
from uika.cli.evaluate import Evaluate
from uika.cli.export import Export
from uika.cli.head import Head
from uika.cli.reconstruct import Reconstruct
from uika.cli.render import Render
from uika.cli.sign import Sign
from uika.cli.study import Study
from uika.cli.synthesize import Synthesize
from uika.cli.track import Track
from uika.cli.train import Train
from uika.cli.verify import Verify
from uika.cli.view import View
from uika.cli.weights import Weights

Command = (
    Reconstruct
    | Animate
    | Track
    | Render
    | View
    | Export
    | Verify
    | Sign
    | Demo
    | Head
    | Train
    | Synthesize
    | Evaluate
    | Study
    | Weights
    | Bench
    | Doctor
)
