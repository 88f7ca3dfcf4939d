"""Points of the surface in the fit, and how they are found in a map of correspondences."""

import pytest
import torch

from tests.train.common import PaintedPerson
from uika.data.labels import tracked_uv
from uika.data.views import View
from uika.fitting import SurfaceMarks, fit_landmarks
from uika.head import HeadModel, HeadParameters, load_head, look_at, pose_vertices, project, vertex_normals
from uika.reconstruction.surface_marks import find_points, surface_points

SIZE = 512


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head().without_bust


def seen(head: HeadModel, yaw: float, seed: int) -> tuple[torch.Tensor, SurfaceMarks, torch.Tensor]:
    """Landmarks [1,478,2] and surface marks of a random person at rest, and the person's identity."""
    random = torch.Generator().manual_seed(seed)
    identity = 0.8 * torch.randn(len(head.identity_basis), generator=random)
    vertices = pose_vertices(head, HeadParameters.zeros(head).replace(identity=identity))
    camera = look_at(yaw, 5.0, 1.1, fov_y=20.0, size=SIZE)
    marks = torch.full((1, 478, 2), SIZE / 2)
    marks[0, head.landmark_ids] = project(head.landmarks(vertices), camera)[0]
    triangle, barycentric, _ = surface_points(head, 200)
    points = SurfaceMarks(triangle, barycentric, torch.zeros(1, 200, 2), torch.zeros(1, 200))
    place, _ = project(points.on(head, vertices), camera)
    normal = torch.nn.functional.normalize(points.on(head, vertex_normals(vertices, head.faces)), dim=-1)
    ray = torch.nn.functional.normalize(camera.position - points.on(head, vertices), dim=-1)
    visible = ((normal * ray).sum(-1) > 0.2).float()
    place = place + 2.0 * torch.randn(place.shape, generator=random)
    return marks, SurfaceMarks(triangle, barycentric, place[None], visible[None]), identity


def shape_error(head: HeadModel, found: torch.Tensor, truth: torch.Tensor, part: str) -> float:
    """Mean distance in mm of a part after a similarity that brings the faces together."""
    a, b = (head.template + torch.einsum("k,kvc->vc", value.float(), head.identity_basis) for value in (found, truth))
    face = head.masks["face"] > 0.5
    a, b = a - a[face].mean(0), b - b[face].mean(0)
    u, s, vt = torch.linalg.svd(a[face].T @ b[face])
    a = a @ (u @ vt) * (s.sum() / a[face].square().sum())
    at = head.masks[part] > 0.5
    return 1e3 * float((a - b)[at].norm(dim=-1).mean())


def test_marks_tell_of_ears_and_skull_where_landmarks_are_blind(head: HeadModel) -> None:
    blind, told = {"ears": 0.0, "face": 0.0}, {"ears": 0.0, "face": 0.0}
    for seed in range(2):
        marks, more, truth = seen(head, 20.0, seed)
        for part in blind:
            blind[part] += shape_error(head, fit_landmarks(marks, head, SIZE).identity, truth, part) / 2
            told[part] += shape_error(head, fit_landmarks(marks, head, SIZE, marks=more).identity, truth, part) / 2
    assert told["ears"] < 0.7 * blind["ears"]
    assert told["face"] < blind["face"] + 0.3


def test_marks_of_no_weight_change_nothing(head: HeadModel) -> None:
    marks, more, _ = seen(head, 0.0, 3)
    nothing = SurfaceMarks(more.triangle, more.barycentric, more.place + 50, torch.zeros_like(more.weight))
    plain, same = fit_landmarks(marks, head, SIZE), fit_landmarks(marks, head, SIZE, marks=nothing)
    assert torch.allclose(plain.identity, same.identity, atol=1e-6)
    assert torch.allclose(plain.error, same.error, atol=1e-6)


def test_points_are_found_in_an_exact_map(head: HeadModel) -> None:
    view = View(PaintedPerson(1).sample(0), 256)
    assert view.parameters is not None
    uv = tracked_uv(view, head)
    triangle, barycentric, places = surface_points(head, 200)
    found, weight = find_points(places, uv.nan_to_num(), torch.isfinite(uv[0]).float())
    points = SurfaceMarks(triangle, barycentric, found[None], weight[None])
    truth, _ = project(points.on(head, pose_vertices(head, view.parameters)), view.camera)
    at = weight > 0
    assert int(at.sum()) > 40
    assert float((found - truth)[at].norm(dim=-1).median()) < 0.5  # pixels of 256
    assert float((found - truth)[at].norm(dim=-1).quantile(0.95)) < 2.0


def test_nothing_is_found_where_nothing_is_trusted(head: HeadModel) -> None:
    _, _, places = surface_points(head, 200)
    found, weight = find_points(places, torch.rand(2, 64, 64), torch.zeros(64, 64))
    assert not weight.any() and torch.isfinite(found).all()
