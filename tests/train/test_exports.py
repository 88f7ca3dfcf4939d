"""Training and evaluation on captures as VHAP exports them, with a made-up FLAME."""

from dataclasses import replace
from pathlib import Path

import pytest

from tests.exports import write_export, write_flame
from tests.train.common import CONFIG, losses, run
from uika.data.datasets import Stored
from uika.evaluate import Evaluation, evaluate, gather
from uika.model import load_checkpoint
from uika.train import MODEL_FILE

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:.*tensorboard.*:DeprecationWarning")]


def test_train_and_evaluate_on_an_export(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("UIKA_HEAD", str(write_flame(tmp_path / "flame.npz")))
    folder = write_export(tmp_path / "data" / "306_EMO-1_v16", cameras=3).parent
    config = replace(CONFIG, steps=10, warmup=2, learning_rate=3e-3, ema=0.0, save_every=10)
    log = run(tmp_path / "run", config, Stored([folder]), overfit=1)
    assert losses(log)[-1] < losses(log)[0]
    # Each note on the data is printed once, however often the person is drawn.
    capsys.readouterr()
    run(tmp_path / "again", replace(config, steps=3), Stored([folder]), progress=True)
    assert "".join(capsys.readouterr()).count("of the teeth are left out") == 1
    assert load_checkpoint(tmp_path / "run" / MODEL_FILE)
    wanted = Evaluation(folder, tmp_path / "report", views=(1, 2), model="none", correspondence="exact", size=128)
    outcome = evaluate(wanted)
    assert outcome.made == 2 and any("teeth are left out" in sentence for sentence in outcome.missing)
    (section,) = gather(tmp_path / "report")
    (metric,) = (each for each in section.metrics if each.name == "PSNR")
    psnr = [row.value(metric) or 0.0 for row in section.rows]
    assert min(psnr) > 20  # with the poses of the canonical file it was 15.5
