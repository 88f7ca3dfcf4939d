"""Many views of one lit pose: light gathered once at the mesh's vertices, then pictures and labels from primary rays.

`scenes.render` asks Mitsuba to follow light for each pixel. Here the emitters of the same scene file are sampled only
at the vertices, with shadows, and the result serves every camera. Each pixel then costs its primary rays alone, which
also carry the labels. Diffuse light is exact up to the interpolation between vertices; highlights use one mean
direction of light for each vertex.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import torch

from scenes.people.glasses import Glasses, glasses_topology
from scenes.shading import highlight, pixel_pattern, plane_points
from scenes.stage import Light, Stage, load_stage
from scenes.variant import FAST_VARIANT, load_mitsuba
from uika.head import Camera, HeadModel, project, vertex_normals

LABELS = ("uv", "depth", "normal", "triangle")
_LIFT = 3e-4  # metres, from the vertex to the point that is lit: clear of its own triangles
_RECORD = 16  # floats for each corner of the mesh
_GLASSES_ROUGHNESS = 0.3


def lit_stage(head: HeadModel, light: Light) -> Stage:
    """A stage for `Shader`, which needs no image size, with the lamps of the scene file."""
    stage = _used_stage(head, light)
    stage.set_lights({})
    return stage


@lru_cache(maxsize=8)
def _used_stage(head: HeadModel, light: Light) -> Stage:
    """A stage that has been used once.

    Kernels that meet freshly loaded numbers differ in their last digits from all later ones; the first use goes here.
    """
    _require_fast(load_mitsuba())
    stage = load_stage(head, 16, 16, light, "direct")
    stage.pose(head, head.template)
    for _ in range(2):
        gather_light(stage, head.template, vertex_normals(head.template, head.faces), 4, 0)
    return stage


def gather_light(stage: Stage, points: torch.Tensor, normals: torch.Tensor, samples: int, seed: int) -> np.ndarray:
    """Direct light at points [N,3] with unit normals [N,3] in the scene of the stage.

    All points share one low-discrepancy set of samples: the error is then smooth along the surface, not grainy.

    Returns:
        [N,6]: the radiance that a white diffuse surface would send out, then the mean direction of the light, which is
        shorter than 1 as the light is spread.
    """
    mi = load_mitsuba()
    import drjit as dr

    lane = dr.arange(mi.UInt32, len(points) * samples)
    vertex = lane // dr.opaque(mi.UInt32, samples)
    point, normal = (mi.Point3f(np.ascontiguousarray(t.numpy().T)) for t in (points + _LIFT * normals, normals))
    set_ = mi.Point2f(np.ascontiguousarray(plane_points(samples, seed).T))
    hit = dr.zeros(mi.SurfaceInteraction3f, len(points) * samples)
    hit.p, hit.n = dr.gather(mi.Point3f, point, vertex), mi.Normal3f(dr.gather(mi.Point3f, normal, vertex))
    place = dr.gather(mi.Point2f, set_, lane % dr.opaque(mi.UInt32, samples))
    sample, weight = stage.scene.sample_emitter_direction(hit, place, True)
    cosine = dr.maximum(dr.dot(sample.d, hit.n), 0.0)
    light = dr.select(sample.pdf > 0, weight * cosine * (dr.inv_pi / samples), 0.0)
    brightness = mi.luminance(light)
    sums = [dr.block_sum(value, samples) for value in (*light, *(brightness * sample.d), brightness)]
    dr.eval(sums)
    columns = np.stack([np.array(value) for value in sums], -1)
    return np.concatenate((columns[:, :3], columns[:, 3:6] / np.maximum(columns[:, 6:], 1e-8)), -1)


class Shader:
    """One lit pose, ready to be seen from any camera."""

    def __init__(
        self,
        stage: Stage,
        head: HeadModel,
        vertices: torch.Tensor,
        texture: Any,
        glasses: Glasses | None = None,
        *,
        exposure: float = 1.0,
        samples: int = 64,
        seed: int = 0,
    ) -> None:
        """Put the pose on the stage and gather its light.

        Args:
            stage: a lit scene, from `lit_stage`; its lamps are used as they are set.
            head: the head model.
            vertices: [V,3] posed vertices, metres.
            texture: from `as_texture`.
            glasses: what the head wears.
            exposure: factor on all light.
            samples: light samples for each vertex.
            seed: of these samples.

        Raises:
            RuntimeError: Mitsuba cannot run its fast variant here.
        """
        mi = load_mitsuba()
        _require_fast(mi)
        stage.pose(head, vertices, None, glasses)
        self._scene, self._texture = stage.scene, texture
        self._outline = vertices
        normals = vertex_normals(vertices, head.faces)
        points, source, faces, texcoords = vertices, stage.mesh.source, stage.mesh.faces, stage.mesh.texcoords
        self._shapes = [mi.ShapePtr(stage.shape("head"))]
        self._head_faces, self._glasses_colour = len(faces), (0.0, 0.0, 0.0)
        if glasses is not None:
            self._shapes.append(mi.ShapePtr(stage.shape("glasses")))
            self._glasses_colour = glasses.colour
            worn, more = torch.from_numpy(glasses.points), torch.from_numpy(glasses_topology()[1].astype(np.int64))
            normals = torch.cat((normals, vertex_normals(worn, more)))
            faces = np.concatenate((faces, more.numpy().astype(np.uint32) + len(source)))
            source = np.concatenate((source, len(points) + np.arange(len(worn))))
            texcoords = np.concatenate((texcoords, np.zeros((len(worn), 2), np.float32)))
            points = torch.cat((points, worn))
        self._outline = points
        light = gather_light(stage, points, normals, samples, seed)
        light[:, :3] *= exposure
        corner = np.zeros((len(source), _RECORD), np.float32)
        corner[:, :11] = np.concatenate((texcoords, normals.numpy()[source], light[source]), -1)
        self._corner = mi.Float(corner.ravel())
        self._faces = mi.UInt32(np.ascontiguousarray(faces).ravel())

    def view(self, camera: Camera, spp: int = 4, labels: Sequence[str] = ("uv",)) -> Mapping[str, np.ndarray]:
        """See the pose from one camera.

        Args:
            camera: one OpenCV camera.
            spp: rays per pixel for colour and mask, on a regular pattern; 1, 4 or 16.
            labels: names out of `LABELS`, taken at pixel centres.

        Returns:
            "rgb" [H,W,3] linear colour where the mask is not 0, not multiplied by it; "mask" [H,W] in [0,1]; and the
            labels: "uv" [H,W,2] v down (0 for none), "depth" [H,W] metres of camera z (0), "normal" [H,W,3] world
            space (0), "triangle" [H,W] int64 (-1).
        """
        if spp not in (1, 4, 16) or not set(labels) <= set(LABELS):
            raise ValueError(f"spp must be 1, 4 or 16 and labels out of {LABELS}, got {spp} and {labels}")
        box = self._box(camera)
        images = self._empty(camera, labels)
        if box[2] > 0 and box[3] > 0:
            self._colour(camera, box, spp, images)
            self._labels(camera, box, labels, images)
        return images

    def _box(self, camera: Camera) -> tuple[int, int, int, int]:
        """x0, y0, width and height of the pixels that can see the head or its glasses."""
        xy, z = project(self._outline.double(), camera)
        if float(z.min()) <= 1e-3:
            return 0, 0, camera.width, camera.height
        limit = torch.tensor([camera.width, camera.height])
        low = torch.minimum((xy.amin(0) - 1).floor().long().clamp_min(0), limit)
        high = torch.minimum((xy.amax(0) + 1).ceil().long().clamp_min(0), limit)
        (x0, y0), (width, height) = low.tolist(), (high - low).tolist()
        return x0, y0, width, height

    def _empty(self, camera: Camera, labels: Sequence[str]) -> dict[str, np.ndarray]:
        size = (camera.height, camera.width)
        every: dict[str, np.ndarray] = {
            "rgb": np.zeros((*size, 3), np.float32),
            "mask": np.zeros(size, np.float32),
            "uv": np.zeros((*size, 2), np.float32),
            "depth": np.zeros(size, np.float32),
            "normal": np.zeros((*size, 3), np.float32),
            "triangle": np.full(size, -1, np.int64),
        }
        return {name: every[name] for name in ("rgb", "mask", *labels)}

    def _cast(self, camera: Camera, box: tuple[int, int, int, int], offset: tuple[float, float]) -> tuple[Any, ...]:
        """First hits of the rays through one point of each pixel of the box: rays, hits, shape seen, view axis."""
        mi = load_mitsuba()
        import drjit as dr

        x0, y0, width, _ = (dr.opaque(mi.UInt32, value) for value in box)
        pixel = dr.arange(mi.UInt32, box[2] * box[3])
        x = mi.Float(x0 + pixel % width) + offset[0]
        y = mi.Float(y0 + pixel // width) + offset[1]
        K = camera.K.double().numpy()
        fx, fy, cx, cy = (dr.opaque(mi.Float, float(value)) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        rotation = camera.viewmat[:3, :3].double().numpy()
        right, down, forward = (mi.Vector3f(*(dr.opaque(mi.Float, float(c)) for c in row)) for row in rotation)
        direction = dr.normalize(right * ((x - cx) / fx) + down * ((y - cy) / fy) + forward)
        origin = mi.Point3f(*(dr.opaque(mi.Float, float(c)) for c in camera.position.double()))
        ray = mi.Ray3f(origin, direction)
        hit = self._scene.ray_intersect_preliminary(ray, coherent=True)
        seen = [hit.is_valid() & (hit.shape == shape) for shape in self._shapes]
        return ray, hit, seen, forward

    def _mixed(self, hit: Any, seen: list[Any], columns: int) -> list[Any]:
        """The first 2, 8 or 12 vertex values at the hits on what is seen: UV, normal, diffuse light, its direction."""
        mi = load_mitsuba()
        import drjit as dr
        from drjit.llvm.ad import ArrayXf

        found, face = seen[0], hit.prim_index
        if len(seen) > 1:
            found, face = seen[0] | seen[1], face + dr.select(seen[1], self._head_faces, mi.UInt32(0))
        b1, b2 = hit.prim_uv.x, hit.prim_uv.y
        lanes = dr.width(face)
        totals = [mi.Float(0)] * columns
        for k, weight in enumerate((1 - b1 - b2, b1, b2)):
            corner = dr.gather(mi.UInt32, self._faces, 3 * face + k, found)
            # Values read in packets of a power of two cost one memory access each.
            first = dr.gather(
                ArrayXf, self._corner, corner * (_RECORD // min(columns, 8)), found, shape=(min(columns, 8), lanes)
            )
            values = [first[c] for c in range(min(columns, 8))]
            if columns == 12:
                rest = dr.gather(ArrayXf, self._corner, corner * (_RECORD // 4) + 2, found, shape=(4, lanes))
                values += [rest[c] for c in range(4)]
            totals = [dr.fma(weight, value, total) for value, total in zip(values, totals, strict=True)]
        return totals

    def _colour(self, camera: Camera, box: tuple[int, int, int, int], spp: int, images: dict[str, np.ndarray]) -> None:
        mi = load_mitsuba()
        import drjit as dr

        sums = [mi.Float(0)] * 4
        for offset in pixel_pattern(spp):
            sums = [total + value for total, value in zip(sums, self._sample(camera, box, offset), strict=True)]
        dr.eval(sums)
        x0, y0, width, height = box
        mask = np.array(sums[3]).reshape(height, width)
        rgb = np.stack([np.array(value) for value in sums[:3]], -1).reshape(height, width, 3)
        images["rgb"][y0 : y0 + height, x0 : x0 + width] = rgb / np.maximum(mask, 1)[..., None]
        images["mask"][y0 : y0 + height, x0 : x0 + width] = mask / spp

    def _sample(self, camera: Camera, box: tuple[int, int, int, int], offset: tuple[float, float]) -> list[Any]:
        """Linear colour and coverage at one point of each pixel of the box."""
        mi = load_mitsuba()
        import drjit as dr

        ray, hit, seen, _ = self._cast(camera, box, offset)
        values = self._mixed(hit, seen, 12)
        normal, diffuse, mean = mi.Vector3f(values[2:5]), mi.Color3f(values[5:8]), mi.Vector3f(values[8:11])
        *albedo, rough = self._texture.eval(mi.Point2f(values[:2]), seen[0])
        found = seen[0]
        if len(seen) > 1:
            found = found | seen[1]
            albedo = [dr.select(seen[1], c, a) for c, a in zip(self._glasses_colour, albedo, strict=True)]
            rough = dr.select(seen[1], _GLASSES_ROUGHNESS, rough)
        colour = mi.Color3f(albedo) * diffuse + highlight(normal, -ray.d, mean, diffuse, rough)
        return [dr.select(found, value, 0.0) for value in (*colour, mi.Float(1))]

    def _labels(
        self, camera: Camera, box: tuple[int, int, int, int], labels: Sequence[str], images: dict[str, np.ndarray]
    ) -> None:
        if not labels:
            return
        mi = load_mitsuba()
        import drjit as dr

        ray, hit, seen, forward = self._cast(camera, box, (0.5, 0.5))
        seen = seen[:1]
        found = seen[0]
        results: dict[str, list[Any]] = {}
        if "uv" in labels:
            results["uv"] = [dr.select(found, value, 0.0) for value in self._mixed(hit, seen, 2)]
        if "depth" in labels:
            results["depth"] = [dr.select(found, hit.t * dr.dot(ray.d, forward), 0.0)]
        if "normal" in labels:
            unit = dr.normalize(mi.Vector3f(self._mixed(hit, seen, 8)[2:5]))
            results["normal"] = [dr.select(found, value, 0.0) for value in unit]
        if "triangle" in labels:
            results["triangle"] = [dr.select(found, mi.Int32(hit.prim_index), -1)]
        dr.eval(list(results.values()))
        x0, y0, width, height = box
        for name, values in results.items():
            layers = [np.array(value).reshape(height, width) for value in values]
            images[name][y0 : y0 + height, x0 : x0 + width] = layers[0] if len(layers) == 1 else np.stack(layers, -1)


def as_texture(albedo: np.ndarray, roughness: np.ndarray) -> Any:
    """A device texture of linear colour [S,S,3] and roughness [S,S], row 0 at v = 0."""
    mi = load_mitsuba()
    _require_fast(mi)
    import drjit as dr

    layers = np.concatenate((albedo, roughness[..., None]), -1).astype(np.float32)
    return mi.Texture2f(mi.TensorXf(np.ascontiguousarray(layers)), wrap_mode=dr.WrapMode.Clamp)


def _require_fast(mi: Any) -> None:
    if mi.variant() != FAST_VARIANT:
        raise RuntimeError(f"views with labels need Mitsuba's {FAST_VARIANT}; install LLVM 16 or newer")
