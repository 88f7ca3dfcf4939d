"""A loaded Mitsuba scene with a head in it, kept and updated from frame to frame."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from scenes.geometry import SeamMesh, cut_seams
from scenes.variant import load_mitsuba
from uika.head import Camera, HeadModel

Light = Literal["studio", "flat"]
LIGHTS = ("studio", "flat")
INTEGRATORS = ("direct", "path")
_FOLDER = Path(__file__).parent
_TEXTURE_KEYS = {"studio": "bsdf.brdf_0.base_color.data", "flat": "emitter.radiance.data"}
_DEFAULT_ALBEDO = (0.55, 0.36, 0.28)  # linear; an even skin tone


@dataclass(frozen=True, eq=False)
class Stage:
    """A scene file loaded for one head and image size."""

    scene: Any
    params: Any
    mesh: SeamMesh
    light: Light

    @property
    def sensor(self) -> Any:
        """The scene's only sensor."""
        return self.scene.sensors()[0]

    def update(self, head: HeadModel, vertices: torch.Tensor, camera: Camera, texture: np.ndarray | None) -> None:
        """Set head vertices [V,3] in metres, camera, and linear texture [S,S,3] (None for an even skin tone)."""
        mi = load_mitsuba()
        albedo = np.full((2, 2, 3), _DEFAULT_ALBEDO, np.float32) if texture is None else texture
        arrays = {"vertex_positions": self.mesh.positions(vertices).ravel(), _TEXTURE_KEYS[self.light]: albedo}
        if "head.vertex_normals" in self.params:
            arrays["vertex_normals"] = self.mesh.normals(vertices, head.faces, camera.position).ravel()
        for name, value in arrays.items():
            key = f"head.{name}"
            self.params[key] = type(self.params[key])(np.ascontiguousarray(value, np.float32))
        for name, number in _sensor_values(camera).items():
            _assign(self.params, f"sensor.{name}", number)
        _assign(self.params, "sensor.to_world", mi.ScalarTransform4f(_sensor_to_world(camera)))
        self.params.update()


@lru_cache(maxsize=8)
def load_stage(head: HeadModel, width: int, height: int, light: Light, integrator: str) -> Stage:
    """Load a scene file once for each head, image size, light and integrator.

    Raises:
        ValueError: the light or the integrator is unknown.
    """
    if light not in LIGHTS or integrator not in INTEGRATORS:
        raise ValueError(
            f"light must be one of {LIGHTS} and integrator of {INTEGRATORS}, not {light!r}, {integrator!r}"
        )
    mi = load_mitsuba()
    mesh = cut_seams(head)
    # Scene files take meshes and textures by file name only; the files are read at once and can go.
    with tempfile.TemporaryDirectory() as folder:
        mesh_file, texture_file = Path(folder) / "head.ply", Path(folder) / "texture.exr"
        _write_mesh(mi, mesh, head.template.numpy()[mesh.source], mesh_file)
        mi.Bitmap(np.full((2, 2, 3), _DEFAULT_ALBEDO, np.float32)).write(str(texture_file))
        scene = mi.load_file(
            str(_FOLDER / f"{light}.xml"),
            mesh=str(mesh_file),
            texture=str(texture_file),
            width=str(width),
            height=str(height),
            integrator=integrator,
        )
    return Stage(scene, mi.traverse(scene), mesh, light)


def _assign(params: Any, key: str, value: Any) -> None:
    # Plain item assignment first compares with the old value, which fails for scalar variants' Python numbers.
    target, kind, _, _ = params.properties[key]
    params.set_dirty(key)
    params.set_property(target, kind, value)


def _write_mesh(mi: Any, mesh: SeamMesh, positions: np.ndarray, path: Path) -> None:
    shape = mi.Mesh("head", len(positions), len(mesh.faces), has_vertex_normals=True, has_vertex_texcoords=True)
    params = mi.traverse(shape)
    arrays = {
        "vertex_positions": positions,
        "vertex_normals": np.zeros_like(positions),
        "vertex_texcoords": mesh.texcoords,
        "faces": mesh.faces,
    }
    for key, value in arrays.items():
        params[key] = type(params[key])(np.ascontiguousarray(value).ravel())
    params.update()
    shape.write_ply(str(path))


def _sensor_values(camera: Camera) -> dict[str, float]:
    K = camera.K.double().numpy()
    return {
        "x_fov": math.degrees(2 * math.atan(camera.width / (2 * K[0, 0]))),
        "principal_point_offset_x": (camera.width / 2 - K[0, 2]) / camera.width,
        "principal_point_offset_y": (camera.height / 2 - K[1, 2]) / camera.height,
    }


def _sensor_to_world(camera: Camera) -> np.ndarray:
    # Mitsuba's cameras have x to the left and y up; OpenCV's have x to the right and y down.
    return np.linalg.inv(camera.viewmat.double().numpy()) @ np.diag([-1.0, -1.0, 1.0, 1.0])
