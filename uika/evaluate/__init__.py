"""Evaluation: self and cross reenactment from one camera or several, and its report."""

from uika.evaluate.protocol import METRICS, Metric, Protocol
from uika.evaluate.report import write_report
from uika.evaluate.runner import Evaluation, Outcome, evaluate, evaluate_all
from uika.evaluate.tables import gather

__all__ = [
    "METRICS",
    "Evaluation",
    "Metric",
    "Outcome",
    "Protocol",
    "evaluate",
    "evaluate_all",
    "gather",
    "write_report",
]
