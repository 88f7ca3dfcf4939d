"""The measured worst case of every stress test, printed at the end when `tests/stress` is asked for by name."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

LONG = os.environ.get("UIKA_STRESS") == "long"
Worst = Callable[[str, float], float]
_WORST: dict[str, dict[str, float]] = {}
_CASES: dict[str, dict[str, str]] = {}

settings.register_profile(
    "stress",
    max_examples=300 if LONG else 5,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
settings.load_profile("stress")


def _name(nodeid: str) -> str:
    return nodeid.split("[")[0]


@pytest.fixture
def worst(request: pytest.FixtureRequest) -> Worst:
    """`worst("image", error)` keeps the largest value of that name in this test, and returns the value."""
    kept = _WORST.setdefault(_name(request.node.nodeid), {})

    def keep(what: str, value: float) -> float:
        kept[what] = max(value, kept.get(what, value))
        return value

    return keep


class Recorder:
    """Notes how each case of each test ended, outside of this folder too."""

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Called by pytest for every phase of every test."""
        if report.when == "call" or report.outcome != "passed":
            case = report.nodeid[len(_name(report.nodeid)) :].strip("[]")
            _CASES.setdefault(_name(report.nodeid), {})[case] = report.outcome


def pytest_configure(config: pytest.Config) -> None:
    """Hooks of a conftest see the tests of its folder only; those of a plugin see all."""
    config.pluginmanager.register(Recorder())


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Print the table; `UIKA_STRESS_TABLE` names a JSON file that receives it, beside what other runs put there."""
    if not (LONG or any("stress" in argument for argument in config.args)):
        return
    if any(_WORST.values()):
        terminalreporter.section("worst measured")
    for test, found in sorted(_WORST.items()):
        for what, value in found.items():
            terminalreporter.write_line(f"{test.split('::')[-1]:<70} {what:<28} {value:.3g}")
    if target := os.environ.get("UIKA_STRESS_TABLE"):
        path = Path(target)
        path.parent.mkdir(parents=True, exist_ok=True)
        table: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
        for test, cases in _CASES.items():
            before = table.get(test, {"cases": {}, "worst": {}})
            table[test] = {"cases": before["cases"] | cases, "worst": before["worst"] | _WORST.get(test, {})}
        path.write_text(json.dumps(table, indent=1, sort_keys=True) + "\n")
