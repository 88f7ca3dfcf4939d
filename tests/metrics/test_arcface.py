import math
from pathlib import Path

import pytest
import torch

from tests.metrics.onnx_files import write_flatten
from uika.errors import UikaError
from uika.metrics.arcface import SIDE, ArcFace, aligned_face, identity_similarity

# Irises, nose and mouth corners of the face mesh, and where ArcFace's training put them in its 112 pixels.
PLACES = {
    468: (38.2946, 51.6963),
    473: (73.5318, 51.5014),
    4: (56.0252, 71.7366),
    61: (41.5493, 92.3655),
    291: (70.7299, 92.2041),
}


def scene(angle: float, scale: float) -> tuple[torch.Tensor, torch.Tensor]:
    """A dark picture with a coloured dot at each of the five points of a turned face, and its landmarks."""
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    landmarks = torch.zeros(478, 2)
    row, column = torch.meshgrid(torch.arange(300) + 0.5, torch.arange(400) + 0.5, indexing="ij")
    picture = torch.zeros(300, 400, 3)
    for index, (number, place) in enumerate(PLACES.items()):
        x, y = scale * turn @ (torch.tensor(place) - 56) + torch.tensor([210.0, 140.0])
        landmarks[number] = torch.tensor([x, y])
        dot = (-((row - y) ** 2 + (column - x) ** 2) / (2 * (2 * scale) ** 2)).exp()
        picture[..., index % 3] += dot
    return picture, landmarks


@pytest.mark.parametrize(("angle", "scale"), [(0.0, 1.0), (0.4, 1.7), (-1.2, 0.8)])
def test_faces_are_aligned(angle: float, scale: float) -> None:
    face = aligned_face(*scene(angle, scale))
    assert face.shape == (SIDE, SIDE, 3)
    row, column = torch.meshgrid(torch.arange(SIDE) + 0.5, torch.arange(SIDE) + 0.5, indexing="ij")
    for index, (x, y) in enumerate(PLACES.values()):
        near = (column - x).square() + (row - y).square() < 7**2
        weight = face[..., index % 3] * near
        found = torch.stack(((weight * column).sum(), (weight * row).sum())) / weight.sum()
        torch.testing.assert_close(found, torch.tensor([x, y]), atol=0.2, rtol=0)


def test_similarity_is_the_cosine_of_embeddings(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="pip install onnxruntime to test CSIM")
    network = ArcFace(write_flatten(tmp_path / "flatten.onnx", SIDE))
    picture, landmarks = scene(0.2, 1.3)
    assert identity_similarity(network, (picture, landmarks), (picture, landmarks)) == pytest.approx(1.0)
    other = picture.flip(-1)
    first, second = ((aligned_face(each, landmarks) * 2 - 1).flatten() for each in (picture, other))
    expected = float(torch.nn.functional.cosine_similarity(first, second, dim=0))
    found = identity_similarity(network, (picture, landmarks), (other, landmarks))
    assert found == pytest.approx(expected, abs=1e-5) and found < 0.999


def test_files_that_are_no_such_network_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="pip install onnxruntime to test CSIM")
    with pytest.raises(UikaError, match=r"none\.onnx: no such"):
        ArcFace(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("no network")
    with pytest.raises(UikaError, match=r"text\.onnx: cannot be read"):
        ArcFace(tmp_path / "text.onnx")
    with pytest.raises(UikaError, match="takes"):
        ArcFace(write_flatten(tmp_path / "small.onnx", 32))
