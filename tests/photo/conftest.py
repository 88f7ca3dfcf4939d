"""The demo portrait, prepared once for all photo tests."""

from pathlib import Path

import pytest

from uika.assets import PORTRAIT
from uika.photo import Photo, prepare


@pytest.fixture(scope="session")
def portrait_path() -> Path:
    return PORTRAIT


@pytest.fixture(scope="session")
def portrait() -> Photo:
    return prepare(PORTRAIT)
