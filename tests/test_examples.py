"""The example with an avatar and the notebook run; those of the rasterizer have tests of their own."""

import json
from pathlib import Path

import av
import pytest

from uika.safeguards import verify

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOK = ROOT / "examples" / "avatar.ipynb"


def test_photo_becomes_a_marked_video(tmp_path: Path) -> None:
    from examples.photo_to_video import main
    from uika.assets import PORTRAIT

    path = tmp_path / "nod.mp4"
    assert main(PORTRAIT, path, seconds=0.4, size=256) == 10
    with av.open(str(path)) as container:
        assert sum(1 for _ in container.decode(video=0)) == 10
    found = verify(path)
    assert found.watermark is not None and found.watermark.found and "photos" in found.provenance


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nbclient = pytest.importorskip("nbclient", reason="no nbclient: install the group 'dev'")
    nbformat = pytest.importorskip("nbformat", reason="no nbformat: install the group 'dev'")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("OMP_WAIT_POLICY", "passive")
    book = nbformat.read(NOTEBOOK, as_version=4)
    nbclient.NotebookClient(book, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in book.cells if cell.cell_type == "code" for output in cell.outputs]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 3
    assert (tmp_path / "avatar.html").stat().st_size > 1e6


def test_notebook_is_kept_without_outputs() -> None:
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    assert all(not cell.get("outputs") and cell.get("execution_count") is None for cell in cells)
