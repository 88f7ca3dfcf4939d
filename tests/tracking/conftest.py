from pathlib import Path

import pytest
import torch

from tests.filmed import act
from uika.head import HeadModel, load_head


@pytest.fixture(scope="session")
def head() -> HeadModel:
    return load_head()


@pytest.fixture(scope="session")
def acted(head: HeadModel, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, torch.Tensor]:
    """`act` in a file of its own, and the turns [T]."""
    path = tmp_path_factory.mktemp("video") / "act.mp4"
    return path, act(head, path)
