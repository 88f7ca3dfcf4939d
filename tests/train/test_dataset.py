"""Items: exact and fitted correspondence, crops, augmentation."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from tests.stress.targets import captures
from tests.train.common import CONFIG, SIZE, PaintedPeople, PaintedPerson
from uika.data.datasets import Stored
from uika.data.views import View
from uika.head import load_head, look_at, pose_vertices, project
from uika.head.alignment import aligned_camera
from uika.head.parameters import HeadParameters
from uika.train import Draw, ItemMaker
from uika.train.augment import degrade, draw_grade

AUGMENTED = replace(CONFIG, augment=True)


def test_an_item_is_a_function_of_its_draw():
    maker = ItemMaker(PaintedPeople(), AUGMENTED)
    first, second, other = maker[Draw(0, 1, 2, 7)], maker[Draw(5, 1, 2, 7)], maker[Draw(0, 1, 2, 8)]
    for name, value in vars(first).items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value.nan_to_num(), getattr(second, name).nan_to_num()), name
    assert not torch.equal(first.images, other.images)


def test_exact_correspondence_agrees_with_the_labels():
    item = ItemMaker(PaintedPeople(), CONFIG)[Draw(0, 0, 2, 1)]
    both = torch.isfinite(item.uv).all(1) & torch.isfinite(item.labels).all(1)
    assert both.float().mean() > 0.1
    assert (item.uv - item.labels).norm(dim=1)[both].median() < 2e-3


def test_a_fitted_item_puts_the_head_where_the_true_one_is():
    exact = ItemMaker(PaintedPeople(), CONFIG)[Draw(0, 0, 2, 1)]
    fitted = ItemMaker(PaintedPeople(), replace(CONFIG, fitted=1.0))[Draw(0, 0, 2, 1)]
    assert not torch.equal(exact.canonical, fitted.canonical)
    face = load_head().without_bust.masks["face"] > 0.5
    places = []
    for item in (exact, fitted):
        camera = look_at(size=SIZE)
        camera = replace(camera, viewmat=item.viewmats[0], K=item.Ks[0])
        places.append(project(item.posed[0], camera)[0][face])
    assert (places[0] - places[1]).norm(dim=-1).mean() < 0.02 * SIZE


def test_jitter_moves_picture_labels_and_camera_together():
    head = load_head().without_bust
    view = View(PaintedPerson(0).sample(0), SIZE)
    view.jitter(np.random.default_rng(2))
    assert view.uv is not None and view.parameters is not None
    points, _ = project(pose_vertices(head, view.parameters), view.camera)
    nose = int(head.template[:, 2].argmax())
    x, y = points[nose].floor().long().tolist()
    uv_of = torch.full((len(head.template), 2), torch.nan)
    uv_of[head.faces.flatten()] = head.uvs[head.uv_faces.flatten()]
    wanted = torch.stack((uv_of[nose, 0], 1 - uv_of[nose, 1]))
    assert (view.uv[:, y, x] - wanted).norm() < 0.03
    assert view.mask[y, x] > 0.99


def test_alignment_undoes_a_motion_and_a_scale():
    head = load_head().without_bust
    vertices = pose_vertices(head, HeadParameters.zeros(head).replace(rotation=torch.tensor([0.1, 0.4, -0.2])))
    camera = look_at(10.0, 5.0, size=SIZE)
    moved = 1.2 * vertices + torch.tensor([0.02, -0.01, 0.05])
    found = aligned_camera(moved, vertices, head.masks["face"], camera)
    torch.testing.assert_close(project(moved, found)[0], project(vertices, camera)[0], rtol=0, atol=1e-2)
    rotation = found.viewmat[:3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3), rtol=0, atol=1e-5)


def test_degraded_pictures_stay_pictures():
    image = PaintedPerson(0).sample(0).image
    changed = 0
    for seed in range(12):
        random = np.random.default_rng(seed)
        result = degrade(draw_grade(random)(image), random)
        assert result.shape == image.shape and float(result.min()) >= 0 and float(result.max()) <= 1
        changed += not torch.allclose(result, image, atol=0.02)
    assert changed > 6


def test_folders_are_trained_on_together(tmp_path: Path) -> None:
    """The ablations of the data are lists of folders."""
    people = {"studio": ("anna", "ben"), "videos": ("cleo",)}
    for folder, names in people.items():
        for name in names:
            (tmp_path / folder / name).mkdir(parents=True)
            captures(tmp_path / folder / name)
    studio, both = Stored([tmp_path / "studio"]), Stored([tmp_path / "studio", tmp_path / "videos"])
    assert (len(studio), len(both)) == (2, 3)
    assert len(both[2]) == len(studio[0]) == 2
