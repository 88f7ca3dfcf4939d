"""What the package says of itself, away from its repository too."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent
AUTHORS = ("Wu", "Zhou", "Hu", "Liu", "Sun", "Wang", "Cao", "Shen", "Zhu")


def project() -> dict[str, Any]:
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 has no tomllib")
    found: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    return found


def test_the_papers_nine_authors_are_cited() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["references"][0]
    assert tuple(author["family-names"] for author in cited["authors"]) == AUTHORS
    assert cited["identifiers"][0]["value"] == "arXiv:2601.07603" and cited["year"] == 2026
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [name for name in AUTHORS if f"{name}," not in readme] == []


def test_the_description_away_from_the_repository_has_no_dead_links_or_pictures() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for step in project()["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]["substitutions"]:
        text = re.sub(step["pattern"], step["replacement"], text)
    assert re.findall(r"\]\((?!https?:)[^)]*\)", text) == [] and "![" not in text
    assert "docs/benchmarks.md" in text and "arxiv.org/abs/2601.07603" in text


def test_the_source_package_holds_what_the_readme_names() -> None:
    included = project()["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    named = {link.partition("/")[0] for link in re.findall(r"\]\((?!https?:)([^)#]+)", readme)} | {"Makefile"}
    assert named <= set(included)
    assert all((ROOT / name).exists() for name in included)


def test_the_dockerfile_installs_extras_that_exist() -> None:
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    extras = re.findall(r"'\.\[([\w,]+)\]'", text)
    assert extras and set(extras[0].split(",")) <= set(project()["project"]["optional-dependencies"])
