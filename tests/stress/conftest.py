"""The measured worst case of every stress test, printed at the end when `tests/stress` is asked for by name."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

LONG = os.environ.get("UIKA_STRESS") == "long"
Worst = Callable[[str, float], float]
_WORST: dict[tuple[str, str], float] = {}

settings.register_profile(
    "stress",
    max_examples=300 if LONG else 5,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
settings.load_profile("stress")


@pytest.fixture
def worst(request: pytest.FixtureRequest) -> Worst:
    """`worst("image", error)` keeps the largest value of that name in this test, and returns the value."""

    def keep(what: str, value: float) -> float:
        key = (request.node.originalname, what)
        _WORST[key] = max(value, _WORST.get(key, value))
        return value

    return keep


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Print the table; `UIKA_STRESS_TABLE` names a file that receives it as Markdown."""
    if not _WORST or not (LONG or any("stress" in argument for argument in config.args)):
        return
    terminalreporter.section("worst measured")
    for (test, what), value in sorted(_WORST.items()):
        terminalreporter.write_line(f"{test:<70} {what:<28} {value:.3g}")
    if target := os.environ.get("UIKA_STRESS_TABLE"):
        rows = [f"| `{test}` | {what} | {value:.2g} |" for (test, what), value in sorted(_WORST.items())]
        Path(target).parent.mkdir(parents=True, exist_ok=True)
        Path(target).write_text("\n".join(["| test | what | worst |", "|---|---|---|", *rows]) + "\n")
