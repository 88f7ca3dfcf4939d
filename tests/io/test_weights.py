import hashlib
from dataclasses import replace
from pathlib import Path

import pytest

from uika.cli import main
from uika.io import weights


def test_nothing_there(tmp_path: Path) -> None:
    found = weights.check_weights(tmp_path)
    assert {status.state for status in found} == {"missing"}
    assert all(status.file.licence and status.file.source.startswith("https://") for status in found)


def test_digest_decides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    digest = hashlib.sha256(b"right").hexdigest()
    first, second = weights.FILES[:2]
    listed = (
        replace(first, sha256=f"{digest[:8]}...{digest[-5:]}"),
        replace(second, sha256=digest),
        replace(second, name="new", sha256=""),
    )
    monkeypatch.setattr(weights, "FILES", listed)
    for file, content in zip(listed, (b"right", b"wrong", b""), strict=True):
        (tmp_path / file.name).write_bytes(content)
    assert [status.state for status in weights.check_weights(tmp_path)] == ["verified", "damaged", "unverified"]
    assert {status.state for status in weights.check_weights(tmp_path, verify=False)} == {"unverified"}


def test_folder_follows_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(weights.FOLDER_VARIABLE, str(tmp_path))
    assert weights.folder() == tmp_path
    monkeypatch.delenv(weights.FOLDER_VARIABLE)
    assert weights.folder().parts[-2:] == ("uika", "weights")


def test_command_lists_files_and_fails_on_damage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(weights.FOLDER_VARIABLE, str(tmp_path))
    assert main(["weights"]) == 0
    printed = capsys.readouterr().out
    assert str(tmp_path) in printed
    assert all(file.name in printed and file.licence in printed for file in weights.FILES)
    (tmp_path / "uika.safetensors").write_bytes(b"half")
    assert main(["weights"]) == 1
    assert "uika.safetensors  damaged" in capsys.readouterr().out
    assert main(["weights", "--no-verify"]) == 0
