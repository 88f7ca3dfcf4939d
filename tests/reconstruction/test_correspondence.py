"""`--correspondence`: an estimator in the place of the fitted head, and in its fit."""

from pathlib import Path

import pytest
import torch

from tests.train.common import CONFIG, run
from uika.assets import CORRESPONDENCE_WEIGHTS, PORTRAIT
from uika.cli import main
from uika.errors import UikaError
from uika.fitting import fit_photos, pixel_uv
from uika.head import HeadModel, load_head
from uika.reconstruction import Report, avatar_from_fit, fit_prepared, load_model
from uika.reconstruction.estimated_pixels import consent, estimated_pixels
from uika.reconstruction.fitted_photos import FittedPhotos, PreparedPhoto, prepare_file
from uika.reconstruction.surface_marks import surface_marks
from uika.train import MODEL_FILE

pytestmark = pytest.mark.filterwarnings("ignore:.*tensorboard.*:DeprecationWarning")


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head().without_bust


@pytest.fixture(scope="module")
def prepared() -> PreparedPhoto:
    return prepare_file(PORTRAIT)


@pytest.fixture(scope="module")
def fitted(head: HeadModel, prepared: PreparedPhoto) -> FittedPhotos:
    return fit_prepared([prepared], head)


def test_the_estimator_agrees_with_the_fit_of_a_real_photo(head: HeadModel, fitted: FittedPhotos) -> None:
    assert fitted.fit is not None
    uv, valid, trust = pixel_uv(fitted.fit, head, fitted.mattes)
    sight = load_model("none", correspondence="both").sight
    assert sight is not None
    found, weight = estimated_pixels(sight, fitted.images, fitted.mattes)
    both = valid[0] & (trust[0] > 0.5) & (weight[0] > 0)
    away = 384 * (found[0, 0].permute(1, 2, 0) - uv[0])[both].norm(dim=-1)
    assert float(both.float().sum() / (trust[0] > 0.5).sum()) > 0.7
    assert float(away.median()) < 25  # texels; places drawn at random from the atlas are 200 apart
    assert not torch.isfinite(found[0, 0, 0][fitted.mattes[0] == 0]).any()
    agreed = consent(sight, fitted.images, torch.where(valid[..., None], uv, torch.nan).permute(0, 3, 1, 2))
    elsewhere = consent(sight, fitted.images, (uv + 0.2).permute(0, 3, 1, 2))
    assert float(agreed[0][both].mean()) > float(elsewhere[0][both].mean()) + 0.05


def test_network_takes_the_fits_place_and_keeps_its_shape(head: HeadModel, fitted: FittedPhotos) -> None:
    assert fitted.fit is not None
    given = (head, fitted.fit, fitted.images, fitted.mattes, fitted.digests)
    fit, network = (
        avatar_from_fit(load_model("none", correspondence=way), *given, Report(), photo_splats=False)
        for way in ("fit", "network")
    )
    assert torch.equal(fit.means, network.means)
    assert torch.isfinite(network.colors).all()
    change = (fit.colors - network.colors).abs().mean()
    assert 0.002 < float(change) < 0.2


def test_both_lets_the_estimator_into_the_fit(head: HeadModel, prepared: PreparedPhoto, fitted: FittedPhotos) -> None:
    loaded = load_model("none", correspondence="both")
    assert loaded.sight is not None and fitted.fit is not None
    marks = surface_marks(loaded.sight, head, fitted.images, fitted.mattes)
    assert int((marks.weight > 0).sum()) >= 5
    helped = fit_prepared([prepared], head, loaded=loaded).fit
    assert helped is not None
    assert not torch.equal(helped.parameters.identity, fitted.fit.parameters.identity)
    assert float(helped.error) < 1.2 * float(fitted.fit.error)  # the landmarks are met as well
    photos = fitted.photos
    alone = fit_photos(photos, head, list(fitted.hairs), images=[photos[0].image], focals=[photos[0].focal])
    assert torch.allclose(alone.parameters.identity, fitted.fit.parameters.identity, atol=1e-5)


def test_what_cannot_go_together_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["-o", str(tmp_path / "a.safetensors")]
    words = ["reconstruct", str(PORTRAIT), *out, "--estimator", str(CORRESPONDENCE_WEIGHTS), "--correspondence", "fit"]
    assert main(words) == 2
    assert "--correspondence fit asks no estimator" in " ".join(capsys.readouterr().err.split())
    run(tmp_path, CONFIG.__class__(**{**vars(CONFIG), "part": "estimator", "steps": 1, "sources": 1, "items": 1}))
    with pytest.raises(UikaError, match="does not say how sure it is"):
        load_model("none", tmp_path / MODEL_FILE, correspondence="both")
    assert load_model("none", tmp_path / MODEL_FILE).correspondence == "network"
    assert load_model("none").correspondence == "fit"
    words = ["train", "--part", "correspondence", "-o", str(tmp_path / "run"), "--preset", "base"]
    assert main(words) == 2
    assert "--preset has no meaning for --part correspondence" in " ".join(capsys.readouterr().err.split())
