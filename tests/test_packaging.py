"""What the package says of itself, away from its repository too."""

import re
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest
import yaml

import drjit_splat
from uika.errors import install_command

ROOT = Path(__file__).resolve().parent.parent
AUTHORS = ("Wu", "Zhou", "Hu", "Liu", "Sun", "Wang", "Cao", "Shen", "Zhu")


def project(folder: Path = ROOT) -> dict[str, Any]:
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 has no tomllib")
    found: dict[str, Any] = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))
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
    extras = re.findall(r"\./drjit_splat '\.\[([\w,]+)\]'", text)
    assert extras and set(extras[0].split(",")) <= set(project()["project"]["optional-dependencies"])


def test_the_splatting_is_a_distribution_of_its_own_which_the_project_depends_on() -> None:
    own, whole = project(ROOT / "drjit_splat"), project()
    needed = {re.split(r"[<>=]", name)[0] for name in own["project"]["dependencies"]}
    assert needed == {"drjit", "numpy", "safetensors", "torch"}
    wanted = next(need for need in whole["project"]["dependencies"] if need.startswith("drjit-splat"))
    least, below = (tuple(map(int, part.split("."))) for part in re.findall(r"[\d.]+", wanted))
    assert least <= tuple(map(int, re.findall(r"\d+", drjit_splat.__version__))) < below
    assert own["project"]["requires-python"] == whole["project"]["requires-python"]
    assert set(own["project"]["dependencies"]) <= set(whole["project"]["dependencies"])
    assert (ROOT / "LICENSE").read_text() == (ROOT / "drjit_splat" / "LICENSE").read_text()


def test_both_are_installed_by_one_command() -> None:
    for name in ("Makefile", "Dockerfile", "CONTRIBUTING.md", "docs/index.md"):
        lines = (ROOT / name).read_text(encoding="utf-8").replace("\\\n", " ").splitlines()
        asked = [line for line in lines if re.search(r"'\.\[[\w,]+\]'", line)]
        assert asked and all("./drjit_splat" in line for line in asked), name


def test_who_lacks_the_splatting_is_told_how_to_get_it() -> None:
    assert "pip install ./drjit_splat" in (install_command("drjit_splat") or "")


def test_the_version_is_told_without_loading_anything() -> None:
    code = (
        "import sys; from drjit_splat.cli import main; code = main(['--version']);"
        "assert not {'torch', 'drjit', 'numpy'} & set(sys.modules); sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == f"drjit-splat {drjit_splat.__version__}\n"


@pytest.mark.slow
def test_the_two_wheels_share_no_file(tmp_path: Path) -> None:
    pip = [sys.executable, "-m", "pip", "wheel", "-q", "--disable-pip-version-check", "--no-deps", "-w", str(tmp_path)]
    subprocess.run([*pip, str(ROOT / "drjit_splat"), str(ROOT)], check=True)
    splat, whole = (next(tmp_path.glob(f"{name}-*.whl")) for name in ("drjit_splat", "uika_drjit"))
    names = [{name for name in zipfile.ZipFile(path).namelist()} for path in (splat, whole)]
    assert not names[0] & names[1] and splat.stat().st_size < 200_000
    code = {str(path.relative_to(ROOT)) for path in (ROOT / "drjit_splat").rglob("*.py")}
    assert {name for name in names[0] if name.endswith(".py")} == code and "drjit_splat/py.typed" in names[0]
