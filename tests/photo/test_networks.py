"""The face models give what mediapipe's own runtime gives (recorded by tools/record_mediapipe.py)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.photo.crops import portrait_crops
from uika.photo.face_mesh import face_meshes as all_meshes
from uika.photo.networks import face_boxes, face_meshes, follow_meshes, person_mask
from uika.photo.regions_of_interest import Region, overlap, sampled

RECORDED = Path(__file__).with_name("mediapipe.npz")
MEAN, LARGEST = 1e-3, 1e-2  # pixels: their float32 regions move a sample by 1/32 of a pixel now and then


@pytest.fixture(scope="module")
def recorded() -> dict[str, np.ndarray]:
    with np.load(RECORDED, allow_pickle=False) as file:
        return dict(file)


def test_boxes_are_those_of_mediapipe(recorded: dict[str, np.ndarray]) -> None:
    for index, boxes in enumerate(face_boxes(portrait_crops())):
        expected = recorded[f"boxes_{index}"]
        assert len(boxes) == len(expected)
        np.testing.assert_allclose(np.array(boxes).reshape(-1, 4), expected, atol=1e-3)


def test_landmarks_are_those_of_mediapipe(recorded: dict[str, np.ndarray]) -> None:
    for index, crop in enumerate(portrait_crops()):
        faces, expected = all_meshes(crop), recorded[f"faces_{index}"]
        assert len(faces) == len(expected) > 0
        error = np.abs(np.array(faces) - expected)
        assert error.mean() < MEAN and error.max() < LARGEST
    largest = face_meshes(portrait_crops()[:1])[0]
    assert largest is not None and np.abs(largest - recorded["faces_0"][0]).max() < LARGEST


def test_a_followed_face_is_where_mediapipe_follows_it(recorded: dict[str, np.ndarray]) -> None:
    meshes = [mesh for _, mesh in follow_meshes(portrait_crops()[:2])]
    for mesh, expected in zip(meshes, recorded["followed"], strict=True):
        # The second region depends on the first landmarks, whose noise it passes on.
        assert mesh is not None and np.abs(mesh - expected).mean() < 5 * MEAN


def test_the_person_is_where_mediapipe_sees_it(recorded: dict[str, np.ndarray]) -> None:
    mask = Image.fromarray(person_mask(portrait_crops()[0])).resize((64, 64), Image.Resampling.BOX)
    np.testing.assert_allclose(np.asarray(mask), recorded["mask"], atol=1e-3)


def test_nothing_is_found_where_there_is_no_face() -> None:
    empty = [np.full((240, 320, 3), 90, dtype=np.uint8), np.zeros((1, 1, 3), dtype=np.uint8)]
    assert face_boxes(empty) == [[], []]
    assert face_meshes(empty) == [None, None]
    assert [mesh for _, mesh in follow_meshes(empty)] == [None, None]


def test_a_region_is_sampled_where_it_lies() -> None:
    ramp = np.zeros((64, 96, 3), dtype=np.uint8)
    ramp[..., 0] = 2 * np.arange(96)
    ramp[..., 1] = 3 * np.arange(64)[:, None]
    upright = sampled(ramp, Region(40.0, 30.0, 32.0, 32.0, 0.0), 32)[0] * 255
    np.testing.assert_allclose(upright[..., 0], np.broadcast_to(2 * np.arange(24, 56), (32, 32)), atol=1e-4)
    turned = sampled(ramp, Region(40.0, 30.0, 32.0, 32.0, np.pi / 2), 32)[0] * 255
    assert turned[0, :, 1] == pytest.approx(3 * np.arange(14, 46), abs=1e-4)
    outside = sampled(ramp, Region(0.0, 0.0, 32.0, 32.0, 0.0), 32, -1.0, border=False)[0]
    assert (outside[:15, :15] == -1).all() and (outside[17:, 17:, 0] > -1).any()


def test_regions_overlap_by_their_shared_area() -> None:
    one = Region(10.0, 10.0, 10.0, 10.0, 0.3)
    assert overlap(one, one) == pytest.approx(1.0)
    assert overlap(one, one._replace(x=15.0)) == pytest.approx(50 / 150)
    assert overlap(one, one._replace(x=40.0)) == 0.0
