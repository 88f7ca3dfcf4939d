"""The programs in README and documentation run as they stand."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

import uika
from tests.avatars import painted_avatar
from tests.spoken import SENTENCE, spoken, write_wav
from uika.assets import PORTRAIT

ROOT = Path(__file__).resolve().parent.parent
PAGES = (ROOT / "README.md", ROOT / "drjit_splat" / "README.md", *sorted((ROOT / "docs").glob("*.md")))
BLOCKS = [
    pytest.param(block, id=f"{page.stem}-{number}")
    for page in PAGES
    for number, block in enumerate(re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL))
]


@pytest.mark.parametrize("block", BLOCKS)
def test_python_blocks_run(block: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("front.jpg", "side.jpg"):
        shutil.copy(PORTRAIT, tmp_path / name)
    painted_avatar(uika.load_head(), 32).save(tmp_path / "me.safetensors")
    write_wav(tmp_path / "voice.wav", spoken(SENTENCE).samples)
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "documentation", "exec"), {"__name__": "documentation"})


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_linked_files_exist(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        if not target.startswith(("http://", "https://", "mailto:")):
            assert (page.parent / target).exists(), f"{page.name} links {target}"


PAPER = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8").partition("## At its full size")[0]
STATEMENTS = [line for line in PAPER.splitlines() if line.startswith("| ") and not line.startswith("| statement")]


@pytest.mark.parametrize("row", STATEMENTS, ids=lambda row: row[2:].split(" |")[0])
def test_statements_of_the_paper_are_held_by_something(row: str) -> None:
    held = re.findall(r"`([\w/]+\.py)::(\w+)`", row.rstrip(" |").rsplit(" | ", 1)[-1])
    assert held, f"no test or code is named in: {row}"
    for path, name in held:
        code = (ROOT / path).read_text(encoding="utf-8")
        assert re.search(rf"^\s*(def|class) {name}\b", code, re.MULTILINE), f"{path} has no {name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_named_tests_exist(page: Path) -> None:
    text = re.sub(r"gsplat 1\.5\.3's.*?\n\n", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target, name in re.findall(r"`((?:tests|uika|drjit_splat|scenes|benchmarks)/[\w/.]+\.py)(?:::(\w+))?`", text):
        assert (ROOT / target).is_file(), f"{page.name} names {target}"
        assert not name or re.search(rf"\b{name}\b", (ROOT / target).read_text(encoding="utf-8")), f"{target}::{name}"


def test_the_site_shows_every_page_once_in_four_groups() -> None:
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    navigation = text[text.index("\nnav:") :]
    assert sorted(re.findall(r": ([\w-]+\.md)$", navigation, re.MULTILINE)) == sorted(
        page.name for page in PAGES if page.parent.name == "docs"
    )
    groups = re.findall(r"^  - (.+):$", navigation, re.MULTILINE)
    assert groups == ["Start", "Guides", "How it works", "Results and reference"]
