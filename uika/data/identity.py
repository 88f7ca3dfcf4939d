"""All images of one synthetic person."""

from __future__ import annotations

import io
import json
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import torch

from uika.data.encode import DEPTH_UNIT, UV_STEPS, encode_jpeg, encode_pixels, encode_uv
from uika.data.performance import perform, place_camera, viewpoints
from uika.head import Camera, HeadModel, HeadParameters, pose_vertices, shaped_vertices, vertex_normals

if TYPE_CHECKING:
    from scenes.synthesis.deferred import StoredView

_SPP = 4
_LIGHT_SAMPLES = (32, 64)  # for each vertex, in images below and from 256 pixels on
_ENCODERS = 2
_WAITING = 1  # moments that may wait for their encoders beside the one at hand
# One stream of random numbers for each purpose, so that none depends on how often another was asked.
_STREAMS = {"person": 0, "motion": 1, "light": 2, "camera": 3, "backdrop": 4, "samples": 5}


class FrameFiles(NamedTuple):
    """One moment of a performance."""

    flame: tuple[str, bytes]  # path inside the capture, content
    views: list[tuple[dict[str, Any], dict[str, bytes]]]  # entry of the description; its key -> content of that file


@dataclass(frozen=True)
class Recording:
    """What is kept of a person."""

    views: int
    frames: int
    size: int  # pixels
    labels: Literal["full", "tracked"] = "full"  # tracked: none, the head's parameters say what each pixel shows
    images: Literal["png", "jpeg"] = "png"


def generate_identity(
    head: HeadModel, seed: int, identity: int, views: int, frames: int, size: int, **kept: Any
) -> Iterator[tuple[str, bytes]]:
    """Files of the capture of one person as (path inside its folder, content), in a fixed order.

    All depends on the arguments alone. The folder holds `transforms.json` and parameter files as VHAP exports them, and
    beside `images/` and `fg_masks/` the exact labels `uv/` and `depth/` (see `uika.data.encode`); `kept` are fields of
    `Recording`.
    """
    shared, moments = record_identity(head, seed, identity, Recording(views, frames, size, **kept))
    canonical = shared.pop("canonical")
    yield "canonical_flame_param.npz", canonical
    entries = []
    for moment in moments:
        yield moment.flame
        for entry, files in moment.views:
            entries.append(entry)
            yield from ((entry[kind], data) for kind, data in files.items())
    yield "transforms.json", json.dumps({**shared, "frames": entries}, indent=1).encode()


def record_identity(
    head: HeadModel, seed: int, identity: int, recording: Recording, start: int = 0
) -> tuple[dict[str, Any], Iterator[FrameFiles]]:
    """What all moments of one person share (its canonical parameters as `canonical`), and the moments from `start` on.

    No moment depends on those before it, so that a recording can be taken up at any of them.
    """
    from scenes.people import paint, sample_person, wear_glasses
    from scenes.people.hair import hair_offsets
    from scenes.synthesis.deferred import Shader, as_texture
    from scenes.synthesis.lighting import backdrop, sample_lighting
    from scenes.synthesis.vertex_light import lit_scene

    views, frames, size = recording.views, recording.frames, recording.size
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

    def moments() -> Iterator[FrameFiles]:
        waiting: deque[tuple[int, list[Future[dict[str, bytes]]]]] = deque()
        with ThreadPoolExecutor(_ENCODERS) as pool:
            for frame in range(start, frames):
                posed = pose_vertices(head, params[frame], offset)
                glasses = None
                if person.glasses:
                    glasses = wear_glasses(person.glasses, head, params[frame], bare, person.shape)
                shader = Shader(
                    head_scene,
                    head,
                    posed,
                    texture,
                    glasses,
                    exposure=exposure,
                    samples=_LIGHT_SAMPLES[size >= 256],
                    seed=samples,
                )
                seen = shader.stored_views(cameras, backdrops, UV_STEPS, DEPTH_UNIT, _SPP)
                waiting.append((frame, [pool.submit(_encode, images, recording) for images in seen]))
                if len(waiting) > _WAITING:
                    yield finished(*waiting.popleft())
            while waiting:
                yield finished(*waiting.popleft())

    def finished(frame: int, encoded: list[Future[dict[str, bytes]]]) -> FrameFiles:
        pairs = []
        for view, (camera, files) in enumerate(zip(cameras, encoded, strict=True)):
            pairs.append((_entry(frame, view, camera, recording), files.result()))
        return FrameFiles((f"flame_param/{frame:05d}.npz", _npz(**_flame(params[frame]))), pairs)

    shared = {
        "canonical": _npz(shape=person.shape[None], static_offset=offset[None]),
        "head_id": head.id,
        "person": {"cut": person.cut, "beard": person.beard, "glasses": person.glasses is not None},
        "light": lighting.light,
    }
    return shared, moments()


def texture_size(size: int) -> int:
    """Side of the atlas in texels that suits images of `size` pixels."""
    return min(max(256, 3 * size // 2), 1024)


def _encode(images: StoredView, recording: Recording) -> dict[str, bytes]:
    colour = encode_jpeg(images.rgb) if recording.images == "jpeg" else encode_pixels(images.rgb)
    files = {"file_path": colour, "fg_mask_path": encode_pixels(images.mask)}
    if recording.labels == "full":
        files |= {"uv_path": encode_uv(images.uv), "depth_path": encode_pixels(images.depth)}
    return files


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


def _entry(frame: int, view: int, camera: Camera, recording: Recording) -> dict[str, Any]:
    to_world = torch.linalg.inv(camera.viewmat.double())
    to_world[:3, 1:3] *= -1  # OpenGL axes
    name = f"{frame:05d}_{view:02d}"
    K = camera.K.double()
    entry = {
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
        "file_path": f"images/{name}.{'jpg' if recording.images == 'jpeg' else 'png'}",
        "fg_mask_path": f"fg_masks/{name}.png",
        "flame_param_path": f"flame_param/{frame:05d}.npz",
    }
    if recording.labels == "full":
        entry |= {"uv_path": f"uv/{name}.png", "depth_path": f"depth/{name}.png"}
    return entry
