import pytest

from tests.avatars import painted_avatar
from tests.heads import sphere_head
from uika import Avatar, HeadModel


@pytest.fixture(scope="session")
def head() -> HeadModel:
    return sphere_head()


@pytest.fixture(scope="session")
def avatar(head: HeadModel) -> Avatar:
    return painted_avatar(head, 48)
