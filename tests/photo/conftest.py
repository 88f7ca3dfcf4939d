"""The demo portrait, prepared once for all photo tests."""

from pathlib import Path

import pytest

import uika
from uika.photo import Photo, prepare

PORTRAIT = Path(uika.__file__).parent / "assets" / "portrait.jpg"


@pytest.fixture(scope="session")
def portrait_path() -> Path:
    return PORTRAIT


@pytest.fixture(scope="session")
def portrait() -> Photo:
    return prepare(PORTRAIT)
