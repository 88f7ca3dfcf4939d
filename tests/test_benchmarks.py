import subprocess
import sys
from pathlib import Path

import pytest

import benchmarks.__main__ as runner
from benchmarks import compare, sources, summary
from tools import readme_figures

FOLDER = Path(runner.__file__).parent


def test_the_scripts_that_are_run_write_figures() -> None:
    for name in runner.SCRIPTS:
        text = (FOLDER / f"{name}.py").read_text()
        assert "def main(argv" in text and ("save(" in text or "write_text" in text), name


@pytest.mark.parametrize("path", sorted((FOLDER / "results").glob("*.json")), ids=lambda path: path.stem)
def test_every_result_can_be_compared(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert compare.main([str(path), str(path)]) == 0
    assert "0 worse, 0 better, 0 gone" in capsys.readouterr().out


@pytest.mark.parametrize("path", sources.results(), ids=lambda path: path.name)
def test_every_result_and_picture_has_a_script_that_names_it(path: Path) -> None:
    script = sources.script(path)
    if script is None:
        assert sources.command(path) == sources.DRAWN and path.suffix == ".svg"
        return
    assert script.is_file(), f"{path.name} has no script: {script}"
    named = {path.stem, *sources.command(path).split("--name ")[1:]}
    if path.parent != FOLDER / "results" or path.stem in sources.COMMANDS:
        named |= {path.stem.removeprefix("stress_"), path.stem.removesuffix("_paper")}
    assert any(name in script.read_text() for name in named), f"{script.name} does not write {path.name}"


@pytest.mark.parametrize("page", readme_figures.PAGES, ids=lambda page: page.stem)
def test_pages_show_the_results_as_they_are(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert readme_figures.filled(text) == text, "run python tools/readme_figures.py"
    assert all(readme_figures.table(name) for _, name, _ in readme_figures.MARKED.findall(text))


def test_the_summary_is_taken_from_the_results() -> None:
    assert readme_figures.table("summary") == summary.table(), "run python -m benchmarks.summary"


def test_no_command_is_listed_for_what_is_not_there() -> None:
    assert set(sources.COMMANDS) <= {path.stem for path in sources.results()}


def test_a_script_that_writes_nothing_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BENCHMARK_RESULTS", str(tmp_path))
    monkeypatch.setattr(runner, "SCRIPTS", {"compare": ()})
    monkeypatch.setattr(runner, "QUICK_RESULTS", tmp_path)

    def silent(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(subprocess, "run", silent)
    with pytest.raises(SystemExit, match=r"did not write compare.json, compare.md, compare.png"):
        runner.run("compare", quick=True)


def test_names_are_checked(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        runner.main(["nonsense"])
    assert "no benchmark is called nonsense" in capsys.readouterr().err


@pytest.mark.slow
def test_a_quick_run_writes_everything(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", "--quick", "rasterizer_skips"], capture_output=True, text=True, check=True
    )
    assert "rasterizer_skips ..." in done.stdout


@pytest.mark.slow
def test_the_network_is_timed_and_rows_are_kept(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "uika", "bench", "model", "--views", "1", "-o", str(tmp_path)]
    subprocess.run(command, capture_output=True, text=True, check=True)
    rows = (tmp_path / "tiny" / "rows.jsonl").read_bytes()
    assert rows.count(b"\n") == 5 and "cached increment" in (tmp_path / "model_latency.md").read_text()
    subprocess.run(command, capture_output=True, text=True, check=True)
    assert (tmp_path / "tiny" / "rows.jsonl").read_bytes() == rows
