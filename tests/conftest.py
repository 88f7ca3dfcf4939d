"""A fixture of all tests, and the last line of a run, which says which tests were skipped and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Let torch work in one thread."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def skipped(stats: dict[str, list[Any]]) -> str:
    """One line from the reports of the terminal: how many tests each reason left out.

    A skipped module counts as one: how many tests it holds is not known.
    """
    reasons: Counter[str] = Counter()
    for report in stats.get("skipped", []):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        reasons[reason.removeprefix("Skipped: ").removeprefix("skipped: ")] += 1
    line = "; ".join(f"{count} ({reason})" for reason, count in reasons.most_common()) or "none"
    deselected = len(stats.get("deselected", []))
    return f"Skipped: {line}." + (f" Not selected: {deselected}." if deselected else "")


@pytest.hookimpl(wrapper=True, tryfirst=True)  # outermost: after the line of totals
def pytest_sessionfinish(session: pytest.Session) -> Iterator[None]:
    result = yield
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter is not None:
        reporter.write_line(skipped(reporter.stats))
    return result
