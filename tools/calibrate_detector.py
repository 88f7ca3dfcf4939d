"""Measure what the face mesh detector gets wrong on everyone and write `uika/assets/detector_bias.npz`.

Random people of `scenes.people`, in random light and with random expressions, are rendered from random sides. The
distance between what the detector finds and where the embedded landmarks really are is regressed on the viewing angle;
pictures count twice, as they are and mirrored. The result is taken relative to a frontal view, from which the landmarks
were embedded: there the detector's points are what a fit has to meet.

Run `python tools/calibrate_detector.py [--people 84]`; 84 people take a quarter of an hour of processor time.
"""

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from scenes.colour import linear_to_srgb
from scenes.people import paint, sample_person, wear_glasses
from scenes.people.hair import hair_offsets
from scenes.synthesis.deferred import Shader, as_texture
from scenes.synthesis.lighting import backdrop, sample_lighting
from scenes.synthesis.vertex_light import gather_light, lit_scene
from uika.assets import LANDMARK_BIAS
from uika.data.performance import perform
from uika.fitting.landmark_bias import upright, view_polynomials
from uika.fitting.landmarks import MESH_POINTS, eye_distance
from uika.head import (
    Camera,
    HeadModel,
    HeadParameters,
    load_head,
    look_at,
    pose_vertices,
    project,
    shaped_vertices,
    vertex_normals,
)
from uika.io.files import replacing
from uika.photo.networks import face_meshes

SIZE = 512
FACES, VIEWS = 6, 2  # expressions of each person, and views of each expression
YAW, PITCH = 65.0, 22.0  # degrees to either side
FOV, FIELD = (12.0, 26.0), (0.3, 0.4)  # degrees, and metres that the frame shows
FIRST_SEED = 1_000_000  # far from the seeds of benchmarks
LIGHT_SAMPLES = 64
LOST = 0.15  # median error, in eye-corner distances, from which the detector saw something else
RIDGE = 0.1


@dataclass(frozen=True)
class Errors:
    """N pictures: directions to the camera [N,3] in head space, and landmark errors [N,L,2] of the upright picture."""

    direction: Tensor
    error: Tensor


def measure(head: HeadModel, index: int) -> Errors:
    """Errors on one person, in outer eye-corner distances."""
    pictures, cameras, marks = zip(*photograph(head, index), strict=True)
    found = face_meshes(list(pictures))
    directions, errors = [], []
    for mesh, camera, true in zip(found, cameras, marks, strict=True):
        if mesh is None:
            continue
        rotation = camera.viewmat[:3, :3].double()
        unit = camera.K[0, 0].double() * eye_distance(head) / camera.viewmat[2, 3].double()
        error = (torch.from_numpy(mesh)[head.landmark_ids] - true.double()) / unit
        directions.append(-rotation[2])
        errors.append(error @ upright(rotation[None])[0].mT)
    if not errors:
        return Errors(torch.zeros(0, 3).double(), torch.zeros(0, len(head.landmark_ids), 2).double())
    return Errors(torch.stack(directions), torch.stack(errors))


def photograph(head: HeadModel, index: int) -> Iterator[tuple[np.ndarray, Camera, Tensor]]:
    """Pictures [S,S,3] of a person with their cameras and the embedded landmarks [L,2] in pixels."""
    random = np.random.default_rng([FIRST_SEED, index])
    person = sample_person(FIRST_SEED + index, head)
    lighting = sample_lighting(random)
    head_scene = lit_scene(head, lighting.light)
    head_scene.set_lights(lighting.values)
    texture = as_texture(*paint(person, head, SIZE))
    hair = hair_offsets(person, head)
    params = perform(head, person.shape, 4 * FACES - 3, random)[torch.arange(0, 4 * FACES - 3, 4)]
    still = torch.zeros(FACES, 3)
    # Every other person moves the face as little as people who pose for a photo.
    strength = 0.5 if index % 2 else 1.0
    params = params.replace(expression=strength * params.expression, rotation=still, neck=still, translation=still)
    bare = shaped_vertices(head, HeadParameters.zeros(head).replace(identity=person.shape))
    normals = vertex_normals(bare, head.faces)
    head_scene.pose(head, bare + hair)
    face = head.masks["face"] > 0.5
    light = gather_light(head_scene, bare[face], normals[face], LIGHT_SAMPLES, index)[:, :3].mean()
    posed, plain = pose_vertices(head, params, hair), pose_vertices(head, params)
    for n in range(FACES):
        glasses = wear_glasses(person.glasses, head, params[n], bare, person.shape) if person.glasses else None
        exposure = lighting.brightness / max(float(light), 1e-4)
        shader = Shader(
            head_scene, head, posed[n], texture, glasses, exposure=exposure, samples=LIGHT_SAMPLES, seed=index
        )
        for _ in range(VIEWS):
            fov = random.uniform(*FOV)
            distance = random.uniform(*FIELD) / 2 / math.tan(math.radians(fov) / 2)
            yaw, pitch = random.uniform(-YAW, YAW), random.uniform(-PITCH, PITCH)
            camera = look_at(yaw, pitch, distance, (0.0, -0.012, -0.01), fov_y=fov, size=SIZE)
            seen = shader.view(camera, 4, ())
            alpha = seen["mask"][..., None]
            picture = linear_to_srgb(seen["rgb"]) * alpha + backdrop(random, SIZE) * (1 - alpha)
            marks = project(head.landmarks(plain[n]), camera)[0]
            yield (picture.clip(0, 1) * 255).round().astype(np.uint8), camera, marks


def regress(head: HeadModel, errors: Errors) -> Tensor:
    """Coefficients [F,478,2] over `view_polynomials`: zero for a frontal view, and for points not embedded."""
    flip = torch.tensor([-1.0, 1.0, 1.0]).double()
    place = head.landmarks(head.template).double()
    twin = torch.cdist(place, place * flip).argmin(1)
    kept = errors.error.norm(dim=-1).median(-1).values < LOST
    direction, error = errors.direction[kept], errors.error[kept]
    features = view_polynomials(torch.cat((direction, direction * flip)))
    targets = torch.cat((error, error[:, twin] * flip[:2])).flatten(1)
    normal = features.mT @ features + RIDGE * torch.eye(features.shape[1]).double()
    bias = torch.zeros(features.shape[1], MESH_POINTS, 2).double()
    bias[:, head.landmark_ids] = torch.linalg.solve(normal, features.mT @ targets).unflatten(1, (-1, 2))
    front = view_polynomials(torch.tensor([[0.0, 0.0, 1.0]]).double())
    bias[0] -= torch.einsum("nf,flc->lc", front, bias)
    return bias


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=84)
    parser.add_argument("-o", "--output", type=Path, default=LANDMARK_BIAS)
    arguments = parser.parse_args()
    head = load_head().without_bust
    measured = []
    for index in range(arguments.people):
        measured.append(measure(head, index))
        print(f"person {index + 1} of {arguments.people}", flush=True)
    errors = Errors(torch.cat([m.direction for m in measured]), torch.cat([m.error for m in measured]))
    bias = regress(head, errors)
    with replacing(arguments.output) as temporary:
        np.savez_compressed(temporary, bias=bias.numpy().astype(np.float16))
    print(f"wrote {arguments.output} from {len(errors.direction)} pictures")


if __name__ == "__main__":
    main()
