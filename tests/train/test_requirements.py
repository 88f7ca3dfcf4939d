"""What presets need before they start, and the files that give it."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from tests.model.released_files import randomize, released_tensors, write
from tests.train.common import CONFIG, MICRO, SIZE, PaintedPeople, losses, run
from uika.cli import main
from uika.errors import UikaError
from uika.model import CheckpointError, Estimator, load_checkpoint
from uika.model.backbone import VisionTransformer
from uika.model.config import BackboneConfig
from uika.model.estimator_file import read_estimator
from uika.train import MODEL_FILE, TRAINING

pytestmark = pytest.mark.filterwarnings("ignore:.*tensorboard.*:DeprecationWarning")
FROZEN = replace(CONFIG, architecture=replace(MICRO, backbone=replace(MICRO.backbone, frozen=True)), steps=1)


def backbone_file(path: Path, config: BackboneConfig, seed: int = 3) -> Path:
    shapes = {name: tuple(value.shape) for name, value in VisionTransformer(config).state_dict().items()}
    save_file({name: value.contiguous() for name, value in randomize(shapes, seed).items()}, path)
    return path


@pytest.fixture
def backbone(tmp_path: Path) -> Path:
    return backbone_file(tmp_path / "dinov3.safetensors", MICRO.backbone)


@pytest.mark.parametrize("part", ["reconstructor", "estimator"])
@pytest.mark.parametrize("preset", ["base", "paper"])
def test_a_frozen_backbone_without_weights_is_refused(
    preset: str, part: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", "--preset", preset, "--part", part, "-o", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert f"preset '{preset}' needs the weights of DINOv3 ViT-" in said and "--backbone" in said
    assert not (tmp_path / "run" / "log.jsonl").exists()


def test_given_weights_are_used_kept_and_named(
    backbone: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(UikaError, match="--backbone"):
        run(tmp_path / "without", FROZEN)
    run(tmp_path / "run", FROZEN, backbone=backbone)
    said = capsys.readouterr().out
    assert f"backbone: {backbone} (sha256 " in said and "M frozen" in said
    kept = load_checkpoint(tmp_path / "run" / MODEL_FILE).encoder.model.state_dict()
    given = VisionTransformer(FROZEN.finished.backbone)
    from uika.model.dinov3 import load_backbone

    load_backbone(given, backbone)
    for name, value in given.state_dict().items():
        torch.testing.assert_close(kept[name], value, rtol=0.01, atol=1e-3)  # kept in bfloat16
    # The checkpoint holds them.
    assert len(run(tmp_path / "run", replace(FROZEN, steps=2), resume=True)) == 2


def test_backbones_of_another_size_or_kind_are_refused(tmp_path: Path, backbone: Path) -> None:
    other = backbone_file(tmp_path / "other.safetensors", replace(MICRO.backbone, dim=64))
    with pytest.raises(CheckpointError, match=r"other\.safetensors: holds a backbone of 2 blocks, 64 channels"):
        run(tmp_path / "run", FROZEN, backbone=other)
    with pytest.raises(CheckpointError, match="holds no DINOv3 backbone"):
        run(tmp_path / "run", FROZEN, backbone=write(tmp_path, {"a.weight": torch.zeros(2)}, "x.safetensors"))
    with pytest.raises(UikaError, match="trains its small backbone from scratch"):
        run(tmp_path / "run", CONFIG, backbone=backbone)


def test_an_estimator_finds_the_correspondence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = replace(CONFIG, steps=1, sources=1, items=1)
    run(tmp_path / "estimator", replace(config, part="estimator"))
    estimator = tmp_path / "estimator" / MODEL_FILE
    plain = losses(run(tmp_path / "plain", config))
    capsys.readouterr()
    log = run(tmp_path / "with", config, estimator=estimator)
    assert losses(log) != plain
    assert "correspondence: of the estimator" in capsys.readouterr().out
    with pytest.raises(UikaError, match="was trained with estimator"):
        run(tmp_path / "with", replace(config, steps=2), resume=True)
    released = write(tmp_path, released_tensors())  # brings an estimator of its own, of FLAME's coordinates
    with pytest.raises(CheckpointError, match="finds the texture coordinates of FLAME, not those of the head model"):
        run(tmp_path / "released", config, estimator=released)
    assert isinstance(read_estimator(released), Estimator)


def test_weights_are_not_taken_for_others(tmp_path: Path, capsys: pytest.CaptureFixture[str], backbone: Path) -> None:
    config = replace(CONFIG, steps=1, sources=1, items=1)
    run(tmp_path / "model", config)
    run(tmp_path / "estimator", replace(config, part="estimator"))
    model, estimator = (str(tmp_path / name / MODEL_FILE) for name in ("model", "estimator"))
    start = ["train", "-o", str(tmp_path / "run")]
    assert main([*start, "--estimator", model]) == 2
    assert f"{model}: is a reconstruction model, not a correspondence estimator; give it with --model" in " ".join(
        capsys.readouterr().err.split()
    )
    assert main([*start, "--estimator", str(backbone)]) == 2
    assert "is a DINOv3 backbone" in capsys.readouterr().err
    assert main([*start, "--part", "estimator", "--estimator", estimator]) == 2
    assert "--init starts an estimator from another" in capsys.readouterr().err
    with pytest.raises(CheckpointError, match="is a correspondence estimator, not a reconstruction model"):
        run(tmp_path / "run", CONFIG, init=Path(estimator))


def test_captures_label_themselves_for_the_estimator(tmp_path: Path) -> None:
    """Without correspondence images, the tracked head says what each pixel shows."""
    from tests.train.common import PaintedPerson
    from uika.data import Sample
    from uika.data.labels import tracked_uv
    from uika.data.views import View
    from uika.head import load_head

    sample = PaintedPerson(1).sample(0)
    exact = View(sample, SIZE)
    bare = Sample(**{**vars(sample), "uv": None, "uv_valid": None})
    found = tracked_uv(View(bare, SIZE), load_head().without_bust)
    assert exact.uv is not None
    torch.testing.assert_close(found, exact.uv, rtol=0, atol=2e-5, equal_nan=True)

    class Unlabelled(PaintedPeople):
        def __getitem__(self, index):
            person = PaintedPerson(index)
            whole = person.sample
            person.sample = lambda at: Sample(**{**vars(whole(at)), "uv": None, "uv_valid": None})
            return person

    config = replace(CONFIG, part="estimator", steps=1, sources=1, items=1)
    assert losses(run(tmp_path / "a", config, Unlabelled())) == pytest.approx(losses(run(tmp_path / "b", config)))


def test_the_presets_that_ship_are_the_ones_described() -> None:
    assert TRAINING["tiny"].finished.backbone.frozen is False
    assert all(TRAINING[name].finished.backbone.frozen for name in ("base", "paper"))
