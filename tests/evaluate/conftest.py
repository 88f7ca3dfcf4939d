from pathlib import Path

import pytest

from uika.data import Synthesis, synthesize
from uika.evaluate import Evaluation, evaluate, write_report


@pytest.fixture(scope="session")
def people(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two people, four cameras, three moments."""
    folder = tmp_path_factory.mktemp("held out") / "people"
    synthesize(Synthesis(folder, identities=2, views=4, frames=3, size=128, seed=7), progress=False)
    return folder


@pytest.fixture(scope="session")
def settings(people: Path, tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    """Settings whose report is complete."""
    wanted = Evaluation(
        people,
        tmp_path_factory.mktemp("report"),
        setting="multi",
        views=(1, 2, 16),
        model="none",
        correspondence="exact",
        size=96,
        targets=2,
    )
    outcome = evaluate(wanted)
    assert (outcome.made, outcome.kept) == (4, 0)
    write_report(wanted.output)
    return wanted
