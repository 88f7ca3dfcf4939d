"""All images of one synthetic person."""

from __future__ import annotations

import io
import json
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from uika.data.encode import DEPTH_UNIT, UV_STEPS, encode_pixels, encode_uv
from uika.data.performance import perform, place_camera, viewpoints
from uika.head import Camera, HeadModel, HeadParameters, pose_vertices, shaped_vertices, vertex_normals

if TYPE_CHECKING:
    from scenes.synthesis.deferred import StoredView

_SPP = 4
_LIGHT_SAMPLES = (32, 64)  # for each vertex, in images below and from 256 pixels on
_ENCODERS = 2
_WAITING = 9  # views that may wait for an encoder
# One stream of random numbers for each purpose, so that none depends on how often another was asked.
_STREAMS = {"person": 0, "motion": 1, "light": 2, "camera": 3, "backdrop": 4, "samples": 5}


def generate_identity(
    head: HeadModel, seed: int, identity: int, views: int, frames: int, size: int
) -> Iterator[tuple[str, bytes]]:
    """Files of the capture of one person as (path inside its folder, content), in a fixed order.

    All depends on the arguments alone. The folder holds `transforms.json` and parameter files as VHAP exports them, and
    beside `images/` and `fg_masks/` the exact labels `uv/` and `depth/` (see `uika.data.encode`).
    """
    from scenes.people import paint, sample_person, wear_glasses
    from scenes.people.hair import hair_offsets
    from scenes.synthesis.deferred import Shader, as_texture
    from scenes.synthesis.lighting import backdrop, sample_lighting
    from scenes.synthesis.vertex_light import lit_scene

    person = sample_person(int(_random(seed, identity, "person").integers(2**31)), head)
    lighting = sample_lighting(_random(seed, identity, "light"))
    head_scene = lit_scene(head, lighting.light)
    head_scene.set_lights(lighting.values)
    texture = as_texture(*paint(person, head, texture_size(size)))
    offset = hair_offsets(person, head)
    params = perform(head, person.shape, frames, _random(seed, identity, "motion"))
    bare = shaped_vertices(head, HeadParameters.zeros(head).replace(identity=person.shape))
    # The same light samples for all frames: others would make the picture flicker.
    samples = int(_random(seed, identity, "samples").integers(2**31))
    exposure = lighting.brightness / _face_radiance(head_scene, head, bare + offset, samples)
    cameras = [
        place_camera(view, size, _random(seed, identity, "camera", index))
        for index, view in enumerate(viewpoints(views))
    ]
    backdrops = [
        (255 * backdrop(_random(seed, identity, "backdrop", index), size) + 0.5).astype(np.uint8)
        for index in range(views)
    ]
    yield "canonical_flame_param.npz", _npz(shape=person.shape[None], static_offset=offset[None])
    posed = pose_vertices(head, params, offset)
    with ThreadPoolExecutor(_ENCODERS) as pool:
        waiting: deque[Future[list[tuple[str, bytes]]]] = deque()
        for frame in range(frames):
            yield f"flame_param/{frame:05d}.npz", _npz(**_flame(params[frame]))
            glasses = wear_glasses(person.glasses, head, params[frame], bare, person.shape) if person.glasses else None
            shader = Shader(
                head_scene,
                head,
                posed[frame],
                texture,
                glasses,
                exposure=exposure,
                samples=_LIGHT_SAMPLES[size >= 256],
                seed=samples,
            )
            seen = shader.stored_views(cameras, backdrops, UV_STEPS, DEPTH_UNIT, _SPP)
            for view, images in enumerate(seen):
                waiting.append(pool.submit(_encode, f"{frame:05d}_{view:02d}.png", images))
                while len(waiting) > max(views, _WAITING):
                    yield from waiting.popleft().result()
        while waiting:
            yield from waiting.popleft().result()
    description = {
        "head_id": head.id,
        "person": {"cut": person.cut, "beard": person.beard, "glasses": person.glasses is not None},
        "light": lighting.light,
        "frames": [_entry(frame, view, camera) for frame in range(frames) for view, camera in enumerate(cameras)],
    }
    yield "transforms.json", json.dumps(description, indent=1).encode()


def texture_size(size: int) -> int:
    """Side of the atlas in texels that suits images of `size` pixels."""
    return min(max(256, 3 * size // 2), 1024)


def _encode(name: str, images: StoredView) -> list[tuple[str, bytes]]:
    return [
        (f"images/{name}", encode_pixels(images.rgb)),
        (f"fg_masks/{name}", encode_pixels(images.mask)),
        (f"uv/{name}", encode_uv(images.uv)),
        (f"depth/{name}", encode_pixels(images.depth)),
    ]


def _random(seed: int, identity: int, stream: str, index: int = 0) -> np.random.Generator:
    return np.random.default_rng([seed, identity, _STREAMS[stream], index])


def _face_radiance(head_scene: Any, head: HeadModel, vertices: torch.Tensor, seed: int) -> float:
    """Mean radiance of a white, resting face."""
    from scenes.synthesis.vertex_light import gather_light

    head_scene.pose(head, vertices)
    face = (head.masks["face"] > 0.5).nonzero()[:, 0]
    normals = vertex_normals(vertices, head.faces)
    light = gather_light(head_scene, vertices[face], normals[face], _LIGHT_SAMPLES[1], seed)[:, :3]
    return max(float(light.mean()), 1e-4)


def _flame(params: HeadParameters) -> dict[str, torch.Tensor]:
    return {
        "shape": params.identity,
        "expr": params.expression[None],
        "rotation": params.rotation[None],
        "neck_pose": params.neck[None],
        "jaw_pose": params.jaw[None],
        "eyes_pose": params.eyes[None],
        "translation": params.translation[None],
    }


def _npz(**tensors: torch.Tensor) -> bytes:
    buffer = io.BytesIO()
    # numpy stamps every entry with 1980, so equal arrays give equal bytes.
    arrays: dict[str, Any] = {name: tensor.contiguous().numpy() for name, tensor in tensors.items()}
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def _entry(frame: int, view: int, camera: Camera) -> dict[str, Any]:
    to_world = torch.linalg.inv(camera.viewmat.double())
    to_world[:3, 1:3] *= -1  # OpenGL axes
    name = f"{frame:05d}_{view:02d}.png"
    K = camera.K.double()
    return {
        "timestep_index": frame,
        "camera_index": view,
        "camera_id": f"{view:02d}",
        "fl_x": float(K[0, 0]),
        "fl_y": float(K[1, 1]),
        "cx": float(K[0, 2]),
        "cy": float(K[1, 2]),
        "w": camera.width,
        "h": camera.height,
        "transform_matrix": to_world.tolist(),
        "file_path": f"images/{name}",
        "fg_mask_path": f"fg_masks/{name}",
        "flame_param_path": f"flame_param/{frame:05d}.npz",
        "uv_path": f"uv/{name}",
        "depth_path": f"depth/{name}",
    }
