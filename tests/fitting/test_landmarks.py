"""The landmark solve recovers what made the landmarks."""

import pytest
import torch
from torch import Tensor

from uika.fitting import fit_landmarks
from uika.head import HeadModel, HeadParameters, load_head, look_at, pose_vertices, project

SIZE = 512


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head().without_bust


def observe(head: HeadModel, yaws: list[float], seed: int, noise: float = 0.0) -> tuple[Tensor, HeadParameters]:
    """Landmarks [N,478,2] of one random person seen from several sides with mild expressions, and the truth."""
    generator = torch.Generator().manual_seed(seed)
    N, K, E = len(yaws), len(head.identity_basis), len(head.expression_names)
    truth = HeadParameters.zeros(head, N).replace(
        identity=(0.8 * torch.randn(K, generator=generator)).expand(N, K),
        expression=0.25 * torch.rand(N, E, generator=generator) * (torch.rand(N, E, generator=generator) < 0.2),
    )
    points = head.landmarks(pose_vertices(head, truth))
    marks = torch.full((N, 478, 2), SIZE / 2)
    for n, yaw in enumerate(yaws):
        camera = look_at(yaw, 5.0, 1.1, fov_y=20.0, size=SIZE)
        marks[n, head.landmark_ids] = project(points[n], camera)[0]
    return marks + noise * torch.randn(marks.shape, generator=generator), truth


def face_error(head: HeadModel, fitted: Tensor, truth: Tensor) -> float:
    """Mean distance in mm of the neutral faces after the best similarity: size and distance cannot be told apart."""
    face = head.masks["face"] > 0.5

    def shape(identity: Tensor) -> Tensor:
        points = head.template + torch.einsum("k,kvc->vc", identity, head.identity_basis)
        points = points[face] - points[face].mean(0)
        return points

    a, b = shape(fitted), shape(truth)
    u, s, vt = torch.linalg.svd(a.T @ b)
    aligned = a @ (u @ vt) * (s.sum() / a.square().sum())
    return float((aligned - b).norm(dim=-1).mean()) * 1e3


def test_exact_landmarks_are_met_closely(head: HeadModel) -> None:
    marks, _ = observe(head, [0.0, 30.0], seed=1)
    fit = fit_landmarks(marks, head, SIZE)
    assert fit.error.max() < 0.008


def test_identity_is_recovered_and_more_views_help(head: HeadModel) -> None:
    errors = {}
    for yaws in ([0.0], [-40.0, 0.0, 40.0]):
        total = 0.0
        for seed in range(2):
            marks, truth = observe(head, yaws, seed=seed, noise=1.0)
            fit = fit_landmarks(marks, head, SIZE)
            total += face_error(head, fit.identity.float(), truth.identity[0]) / 2
        errors[len(yaws)] = total
    mean_face = face_error(head, torch.zeros(len(head.identity_basis)), truth.identity[0])
    assert errors[3] < errors[1] < mean_face
    assert errors[3] < 1.6


def test_a_noted_focal_length_tells_the_distance(head: HeadModel) -> None:
    marks, _ = observe(head, [35.0, -20.0], seed=4, noise=1.5)
    true = SIZE / 2 / torch.tensor(20.0).deg2rad().div(2).tan()
    focal = torch.stack((true, torch.tensor(torch.nan)))
    noted, alone = fit_landmarks(marks, head, SIZE, focal=focal), fit_landmarks(marks, head, SIZE)
    assert (noted.focal[0] / true).log().abs() < 0.03
    assert (noted.focal[0] / true).log().abs() < (alone.focal[0] / true).log().abs()
    with pytest.raises(ValueError, match="focal"):
        fit_landmarks(marks, head, SIZE, focal=torch.tensor([-1.0, 2.0]))
    with pytest.raises(ValueError, match="focal"):
        fit_landmarks(marks, head, SIZE, focal=torch.tensor([900.0]))


def test_outliers_do_not_pull_the_fit(head: HeadModel) -> None:
    marks, _ = observe(head, [10.0], seed=3)
    clean = fit_landmarks(marks, head, SIZE)
    wrong = marks.clone()
    wrong[0, head.landmark_ids[::25]] += torch.tensor([60.0, -40.0])
    spoiled = fit_landmarks(wrong, head, SIZE)
    moved = (spoiled.rotation[0] @ clean.rotation[0].T).diagonal().sum()
    angle = torch.rad2deg(torch.acos(((moved - 1) / 2).clamp(-1, 1)))
    assert angle < 1.0


def test_order_of_photos_does_not_matter(head: HeadModel) -> None:
    marks, _ = observe(head, [-30.0, 0.0, 25.0], seed=5, noise=0.5)
    order = [2, 0, 1]
    first, second = fit_landmarks(marks, head, SIZE), fit_landmarks(marks[order], head, SIZE)
    assert (first.identity - second.identity).abs().max() < 1e-6
    assert (first.expression[order] - second.expression).abs().max() < 1e-6


@pytest.mark.parametrize(
    "landmarks", [torch.zeros(1, 68, 2), torch.zeros(0, 478, 2), torch.full((1, 478, 2), torch.nan)]
)
def test_bad_landmarks_are_refused(head: HeadModel, landmarks: Tensor) -> None:
    with pytest.raises(ValueError, match="landmarks"):
        fit_landmarks(landmarks, head, SIZE)
