import pytest

from tests.heads import sphere_head
from uika.head import HeadModel

pytest.importorskip("mitsuba", reason="skipped: Mitsuba is not installed")


@pytest.fixture(scope="session")
def head() -> HeadModel:
    return sphere_head()
