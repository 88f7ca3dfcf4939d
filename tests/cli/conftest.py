from pathlib import Path

import pytest

from tests.avatars import painted_avatar
from tests.heads import sphere_head
from uika import load_head
from uika.head import save_head


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """An empty working folder beside a small head that is in use, and an avatar of it."""
    save_head(sphere_head(), tmp_path / "small.npz")
    monkeypatch.setenv("UIKA_HEAD", str(tmp_path / "small.npz"))
    painted_avatar(load_head(), 32).save(tmp_path / "a.safetensors")
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"
