"""Which package may import which (docs/architecture.md), held against every import in the code."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
# Package -> packages of the project that it may import; a package is the folder that stands here with the longest path.
PACKAGES: dict[str, set[str]] = {
    "drjit_splat": set(),
    "uika": set(),  # the package itself: errors, version; its public names are loaded when asked for
    "uika.assets": set(),
    "uika.io": set(),
    "uika.photo": {"uika.io", "uika.assets"},
    "uika.uv": set(),
    "uika.metrics": {"uika.io", "uika.assets", "uika.head", "uika.photo", "uika.fitting"},
    "uika.head": {"uika.io", "uika.assets"},
    "uika.head_import": {"uika.head", "uika.io", "uika.photo"},
    "uika.fitting": {"uika.head", "uika.photo", "uika.io", "uika.assets"},
    "uika.canonical": {"uika.head", "uika.uv"},
    "uika.model": {"uika.canonical", "uika.uv", "uika.head", "uika.io"},
    "uika.motion": {"uika.head", "uika.io", "uika.assets"},
    "uika.avatar": {"uika.head", "uika.motion", "uika.io", "drjit_splat"},
    "uika.photo_splats": {"uika.avatar", "uika.head"},
    "uika.tracking": {"uika.fitting", "uika.motion", "uika.avatar", "uika.head", "uika.photo", "uika.io"},
    "uika.export": {"uika.avatar", "uika.motion", "uika.head", "uika.io", "drjit_splat"},
    "uika.safeguards": {"uika.avatar", "uika.export", "uika.io"},
}
PACKAGES["uika.reconstruction"] = {
    package
    for package in PACKAGES
    if package not in ("uika.tracking", "uika.export", "uika.safeguards", "uika.metrics")
}
PACKAGES["scenes"] = {"uika.head", "uika.avatar", "uika.canonical", "uika.io", "drjit_splat"}
PACKAGES["uika.data"] = {*PACKAGES} - {"uika.reconstruction"}
BELOW = set(PACKAGES)
for _package in ("uika.train", "uika.evaluate", "uika.viewer"):
    PACKAGES[_package] = set(BELOW)
PACKAGES["uika.cli"] = set(PACKAGES)
LONGEST = 300  # lines
TOP = {"__init__", "__main__", "_version", "errors"}


def sources() -> list[Path]:
    return sorted(path for name in ("uika", "drjit_splat", "scenes") for path in (ROOT / name).rglob("*.py"))


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {module_of(path): path for path in sources()}


def package_of(module: str) -> str:
    return max((package for package in PACKAGES if module == package or module.startswith(f"{package}.")), key=len)


def imported(module: str, tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and full name of every import, inside functions too."""
    package = module if MODULES.get(module, Path()).name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parent = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*parent, *([base] if base else [])])
            for alias in node.names:
                name = f"{base}.{alias.name}"
                yield node.lineno, name if name in MODULES else base


def trees() -> dict[str, ast.Module]:
    return {module: ast.parse(path.read_text(encoding="utf-8")) for module, path in MODULES.items()}


def forbidden(module: str, tree: ast.AST) -> list[str]:
    """Imports of a module that leave what its package may import."""
    package, found = package_of(module), []
    for line, name in imported(module, tree):
        top = name.partition(".")[0]
        if top in ("benchmarks", "tests", "tools", "examples"):
            found.append(f"{module}:{line} imports {name}: the product knows nothing of it")
        elif top == "mitsuba" and package != "scenes":
            found.append(f"{module}:{line} imports mitsuba, which only scenes does")
        elif top in ("uika", "drjit_splat", "scenes"):
            other = package_of(name)
            lower = module == "uika" or module == "uika.__main__"  # public names, and the command line
            if other not in (package, "uika") and other not in PACKAGES[package] and not lower:
                found.append(f"{module}:{line} imports {name}: {package} may not import {other}")
    return found


def test_nothing_is_imported_upwards() -> None:
    assert [line for module, tree in trees().items() for line in forbidden(module, tree)] == []


def test_the_table_has_no_circle_and_knows_every_package() -> None:
    order: list[str] = []
    left = {package: {other for other in others if other != package} for package, others in PACKAGES.items()}
    while left:
        ready = [package for package, others in left.items() if others <= set(order)]
        assert ready, f"these packages import each other: {sorted(left)}"
        order += ready
        left = {package: others for package, others in left.items() if package not in ready}
    folders = {f"uika.{path.parent.name}" for path in (ROOT / "uika").glob("*/__init__.py")}
    assert folders <= set(PACKAGES), f"packages without a line in the table: {sorted(folders - set(PACKAGES))}"


def test_no_modules_import_each_other_in_a_circle() -> None:
    graph: dict[str, set[str]] = {}
    for module, tree in trees().items():
        # Imports inside functions and for types alone are not run when a module is loaded, but they tie it too.
        graph[module] = {name for _, name in imported(module, tree) if name in MODULES and name != module}
        # A package's __init__ gathers its modules; that they lie in it is no circle.
        graph[module] -= {other for other in graph[module] if module.startswith(f"{other}.")}
    circles, done = [], set()

    def visit(module: str, path: list[str]) -> None:
        if module in path:
            circles.append(" -> ".join([*path[path.index(module) :], module]))
        elif module not in done:
            for other in sorted(graph[module]):
                visit(other, [*path, module])
            done.add(module)

    for module in graph:
        visit(module, [])
    assert circles == []


def test_no_package_exports_a_name_that_one_of_its_modules_bears() -> None:
    shadowed = []
    for module, path in MODULES.items():
        if path.name == "__init__.py":
            inside = {name.rpartition(".")[2] for name in MODULES if name.rpartition(".")[0] == module}
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ImportFrom):
                    names = {alias.asname or alias.name for alias in node.names}
                    source = module if node.level else node.module or ""
                    shadowed += [f"{module}.{name}" for name in names & inside if f"{source}.{name}" not in MODULES]
    assert shadowed == []


def test_files_are_short() -> None:
    long = {module: len(path.read_text(encoding="utf-8").splitlines()) for module, path in MODULES.items()}
    assert {module: lines for module, lines in long.items() if lines > LONGEST} == {}


def test_the_top_of_the_package_is_empty() -> None:
    assert {path.stem for path in (ROOT / "uika").glob("*.py")} == TOP


def documented() -> dict[str, set[str]]:
    """The table of docs/architecture.md: package -> packages that it may import."""
    packages: dict[str, set[str]] = {}
    for line in (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 3 and cells[0].startswith("`"):
            named, above = set(re.findall(r"`([\w.]+)`", cells[2])), set(packages)
            packages[cells[0].strip("`")] = above - named if cells[2].startswith("all above") else named
    return packages


def test_the_documentation_tells_the_same_rules() -> None:
    assert documented() == PACKAGES


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("uika.head.model", "from uika.fitting import fit_photos"),
        ("uika.evaluate.runner", "def f():\n    import uika.train.loop"),
        ("uika.cli.bench", "from benchmarks.model_latency import main"),
        ("uika.data.shards", "import mitsuba"),
        ("drjit_splat.ply", "from uika.io.files import replacing"),
    ],
)
def test_a_broken_rule_is_found(module: str, line: str) -> None:
    assert len(forbidden(module, ast.parse(line))) == 1
