"""A few of the 200 ways in which `tests.stress.perturbed` spoils the demo portrait."""

from pathlib import Path

import pytest

from tests.stress.perturbed import KINDS, mirror_pairs, portrait, try_one


def test_sides_are_exchanged_twice() -> None:
    pairs = mirror_pairs()
    assert pairs[[468, 473]].tolist() == [473, 468]  # the irises
    assert (pairs[pairs] == range(478)).mean() > 0.8  # some marks lie so close that a neighbour is as good


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_spoiled_portraits_are_right_or_refused(kind: str, tmp_path: Path) -> None:
    image, face = portrait()
    for number in (1, 6, 7):
        row = try_one(kind, number, image, face, tmp_path, prepare_only=True)
        assert row.right and (row.refused or row.error is not None), row


def test_one_goes_all_the_way(tmp_path: Path) -> None:
    image, face = portrait()
    row = try_one("mirrored", 2, image, face, tmp_path)
    assert row.right and (row.refused or row.error is not None), row
