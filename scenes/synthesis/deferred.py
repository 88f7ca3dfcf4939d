"""Many views of one lit pose: light gathered once at the mesh's vertices, then pictures and labels from primary rays.

`scenes.render` asks Mitsuba to follow light for each pixel. Here the emitters of the same scene file are sampled only
at the vertices, with shadows, and the result serves every camera. Each pixel then costs its primary rays alone, which
also carry the labels. Diffuse light is exact up to the interpolation between vertices; highlights use one mean
direction of light for each vertex.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from scenes.arrays import aligned, flat
from scenes.head_scene import HeadScene
from scenes.people.glasses import Glasses, glasses_topology
from scenes.synthesis.launch import Launch, launches
from scenes.synthesis.shading import encode_srgb, highlight, pixel_pattern
from scenes.synthesis.vertex_light import gather_light, require_fast
from scenes.variant import keeping_variant, load_mitsuba, step_by_step
from uika.head import Camera, HeadModel, vertex_normals

LABELS = ("uv", "depth", "normal", "triangle")
_CENTRE = (0.5, 0.5)
_RECORD = 16  # floats for each corner of the mesh
_GLASSES_ROUGHNESS = 0.3


@dataclass(frozen=True, eq=False)
class StoredView:
    """A view as whole numbers, ready for a file."""

    rgb: np.ndarray  # [H,W,3] uint8, sRGB in front of the backdrop
    mask: np.ndarray  # [H,W] uint8
    uv: np.ndarray  # [H,W,2] uint16, 0 for none and else 1 + round(uv * steps)
    depth: np.ndarray  # [H,W] uint16, round(depth / unit), 0 for none


class Shader:
    """One lit pose, ready to be seen from any camera."""

    @keeping_variant()
    def __init__(
        self,
        head_scene: HeadScene,
        head: HeadModel,
        vertices: torch.Tensor,
        texture: Any,
        glasses: Glasses | None = None,
        *,
        exposure: float = 1.0,
        samples: int = 64,
        seed: int = 0,
    ) -> None:
        """Pose the head in the scene and gather its light.

        Args:
            head_scene: a lit scene, from `lit_scene`; its lamps are used as they are set.
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
        require_fast(mi)
        import drjit as dr

        head_scene.pose(head, vertices, None, glasses)
        self._scene, self._texture = head_scene.scene, texture
        normals = vertex_normals(vertices, head.faces)
        points, source, faces, texcoords = (
            vertices,
            head_scene.mesh.source,
            head_scene.mesh.faces,
            head_scene.mesh.texcoords,
        )
        self._shapes = [mi.ShapePtr(head_scene.shape("head"))]
        self._head_faces, self._glasses_colour = len(faces), mi.Color3f(0.0)
        if glasses is not None:
            self._shapes.append(mi.ShapePtr(head_scene.shape("glasses")))
            self._glasses_colour = mi.Color3f(*glasses.colour)
            worn, more = torch.from_numpy(glasses.points), torch.from_numpy(glasses_topology()[1].astype(np.int64))
            normals = torch.cat((normals, vertex_normals(worn, more)))
            faces = np.concatenate((faces, more.numpy().astype(np.uint32) + len(source)))
            source = np.concatenate((source, len(points) + np.arange(len(worn))))
            texcoords = np.concatenate((texcoords, np.zeros((len(worn), 2), np.float32)))
            points = torch.cat((points, worn))
        self._outline = points
        # What differs between scenes and people must be data; as constants each would need a kernel of its own.
        dr.make_opaque(self._shapes, self._glasses_colour)
        light = gather_light(head_scene, points, normals, samples, seed)
        light[:, :3] *= exposure
        corner = np.zeros((len(source), _RECORD), np.float32)
        corner[:, :11] = np.concatenate((texcoords, normals.numpy()[source], light[source]), -1)
        self._corner = mi.Float(flat(corner))
        self._faces = mi.UInt32(flat(faces))

    @keeping_variant()
    def view(self, camera: Camera, spp: int = 4, labels: Sequence[str] = ("uv",)) -> dict[str, np.ndarray]:
        """See the pose from one camera.

        Args:
            camera: one OpenCV camera.
            spp: rays per pixel for colour and mask, see `pixel_pattern`; 1, 4 or 16.
            labels: names out of `LABELS`, taken at pixel centres.

        Returns:
            "rgb" [H,W,3] linear colour where the mask is not 0, not multiplied by it; "mask" [H,W] in [0,1]; and the
            labels: "uv" [H,W,2] v down (0 for none), "depth" [H,W] metres of camera z (0), "normal" [H,W,3] world
            space (0), "triangle" [H,W] int64 (-1).
        """
        import drjit as dr

        if not set(labels) <= set(LABELS):
            raise ValueError(f"labels must be out of {LABELS}, got {labels}")
        (launch,) = launches([camera], self._outline)
        layers = self._see(launch, spp, labels)
        cover = layers["mask"][0]
        layers["rgb"] = [value / dr.maximum(cover, 1e-3) for value in layers["rgb"]]
        (images,) = launch.images(layers, {"triangle": np.int64(-1)})
        return images

    def stored_views(
        self, cameras: Sequence[Camera], backdrops: Sequence[np.ndarray], steps: int, unit: float, spp: int = 4
    ) -> Iterator[StoredView]:
        """See the pose from several cameras in few launches.

        Args:
            cameras: OpenCV cameras.
            backdrops: for each camera the picture [H,W,3] uint8, sRGB, behind the head.
            steps: of a stored coordinate, at most 65534.
            unit: metres of one step of a stored depth.
            spp: rays per pixel for colour and mask; 1, 4 or 16.
        """
        return step_by_step(self._stored_views(cameras, backdrops, steps, unit, spp))

    def _stored_views(
        self, cameras: Sequence[Camera], backdrops: Sequence[np.ndarray], steps: int, unit: float, spp: int
    ) -> Iterator[StoredView]:
        mi = load_mitsuba()
        import drjit as dr

        done = 0
        for launch in launches(cameras, self._outline):
            behind = backdrops[done : done + len(launch.cameras)]
            done += len(launch.cameras)
            layers = self._see(launch, spp, ("uv", "depth", "triangle"))
            cover = layers["mask"][0]
            pixels = mi.UInt8(flat(launch.cut(behind)))
            place = 3 * dr.arange(mi.UInt32, dr.width(cover))
            colours = []
            for channel, value in enumerate(layers["rgb"]):
                far = mi.Float(dr.gather(mi.UInt8, pixels, place + channel))
                near = 255 * encode_srgb(value / dr.maximum(cover, 1e-3))
                colours.append(mi.UInt8(dr.fma(cover, near - far, far) + 0.5))
            found = layers["triangle"][0] >= 0
            stored = {
                "rgb": colours,
                "mask": [mi.UInt8(255 * cover + 0.5)],
                "uv": [dr.select(found, mi.UInt32(dr.clip(value, 0, 1) * steps + 1.5), 0) for value in layers["uv"]],
                "depth": [mi.UInt32(dr.clip(layers["depth"][0] / unit + 0.5, 0, 65535))],
            }
            none = np.uint16(0)
            for images in launch.images(stored, {"rgb": behind, "uv": none, "depth": none}):
                yield StoredView(**images)

    def _see(self, launch: Launch, spp: int, labels: Sequence[str]) -> dict[str, list[Any]]:
        """Layers of a launch's pixels, not evaluated: "rgb" (linear, premultiplied), "mask" in [0,1] and the labels."""
        mi = load_mitsuba()
        sums = [mi.Float(0)] * 4
        layers: dict[str, list[Any]] = {}
        for offset in pixel_pattern(spp):
            ray, forward = launch.rays(offset)
            hit = self._scene.ray_intersect_preliminary(ray, coherent=True)
            seen = [hit.is_valid() & (hit.shape == shape) for shape in self._shapes]
            values = self._mixed(hit, seen)
            sums = [total + value for total, value in zip(sums, self._shade(ray, seen, values), strict=True)]
            if offset == _CENTRE:
                layers = _labels(labels, ray, forward, hit, seen[0], values)
        return {"rgb": [value / spp for value in sums[:3]], "mask": [sums[3] / spp], **layers}

    def _mixed(self, hit: Any, seen: list[Any]) -> list[Any]:
        """Twelve vertex values at the hits on what is seen: UV, normal, diffuse light, its direction."""
        mi = load_mitsuba()
        import drjit as dr
        from drjit.llvm.ad import ArrayXf

        found, face = seen[0], hit.prim_index
        if len(seen) > 1:
            found, face = seen[0] | seen[1], face + dr.select(seen[1], self._head_faces, mi.UInt32(0))
        b1, b2 = hit.prim_uv.x, hit.prim_uv.y
        lanes = dr.width(face)
        totals = [mi.Float(0)] * 12
        for k, weight in enumerate((1 - b1 - b2, b1, b2)):
            corner = dr.gather(mi.UInt32, self._faces, 3 * face + k, found)
            # Values read in packets of a power of two cost one memory access each.
            first = dr.gather(ArrayXf, self._corner, corner * (_RECORD // 8), found, shape=(8, lanes))
            rest = dr.gather(ArrayXf, self._corner, corner * (_RECORD // 4) + 2, found, shape=(4, lanes))
            values = [*(first[c] for c in range(8)), *(rest[c] for c in range(4))]
            totals = [dr.fma(weight, value, total) for value, total in zip(values, totals, strict=True)]
        return totals

    def _shade(self, ray: Any, seen: list[Any], values: list[Any]) -> list[Any]:
        """Linear colour and coverage, 0 where nothing is seen."""
        mi = load_mitsuba()
        import drjit as dr

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
    names: Sequence[str], ray: Any, forward: Any, hit: Any, found: Any, values: list[Any]
) -> dict[str, list[Any]]:
    mi = load_mitsuba()
    import drjit as dr

    layers: dict[str, list[Any]] = {}
    if "uv" in names:
        layers["uv"] = [dr.select(found, value, 0.0) for value in values[:2]]
    if "depth" in names:
        layers["depth"] = [dr.select(found, hit.t * dr.dot(ray.d, forward), 0.0)]
    if "normal" in names:
        layers["normal"] = [dr.select(found, value, 0.0) for value in dr.normalize(mi.Vector3f(values[2:5]))]
    if "triangle" in names:
        layers["triangle"] = [dr.select(found, mi.Int32(hit.prim_index), -1)]
    return layers


@keeping_variant()
def as_texture(albedo: np.ndarray, roughness: np.ndarray) -> Any:
    """A device texture of linear colour [S,S,3] and roughness [S,S], row 0 at v = 0."""
    mi = load_mitsuba()
    require_fast(mi)
    import drjit as dr

    layers = np.concatenate((albedo, roughness[..., None]), -1).astype(np.float32)
    return mi.Texture2f(mi.TensorXf(aligned(layers)), wrap_mode=dr.WrapMode.Clamp)
