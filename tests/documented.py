"""The commands that README, documentation and help texts show."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import get_args

from uika.cli.commands import Command
from uika.cli.head import ImportHead, ShowHead

ROOT = Path(__file__).resolve().parent.parent
PAGES = (
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "drjit_splat/README.md")),
    *sorted((ROOT / "docs").glob("*.md")),
)
_PROGRAMS = ("uika", "drjit-splat", "python", "torchrun", "make", "pip", "mkdocs")
_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def shown(page: Path) -> list[str]:
    """The commands in a page's blocks, without comments; continued lines are joined."""
    return _commands(page, ("", "bash"))


def scripted(page: Path) -> list[str]:
    """The commands in a page's scripts, which need files that no test folder has, or each other's."""
    return _commands(page, ("sh",))


def _commands(page: Path, languages: tuple[str, ...]) -> list[str]:
    blocks = (text for language, text in _BLOCK.findall(page.read_text(encoding="utf-8")) if language in languages)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    found = (re.split(r"\s#\s", line)[0].strip().removeprefix("srun ") for line in lines)
    return [line for line in found if line.split(" ")[0] in _PROGRAMS]


def mentioned(page: Path) -> list[str]:
    """The commands in a page's running text."""
    text = _BLOCK.sub("", page.read_text(encoding="utf-8"))
    found = (" ".join(code.split()) for code in re.findall(r"(?<!`)`([^`]+)`(?!`)", text))
    return [code for code in found if code.split(" ")[0] in _PROGRAMS and " " in code]


def examples() -> list[str]:
    """The commands in help texts."""
    docs = (inspect.getdoc(command) or "" for command in (*get_args(Command), ImportHead, ShowHead))
    return [" ".join(doc.split("Example: ")[1].split()) for doc in docs if "Example: " in doc]
