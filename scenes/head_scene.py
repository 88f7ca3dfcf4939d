"""A loaded Mitsuba scene with a head in it, kept and updated from frame to frame."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from scenes.arrays import aligned
from scenes.geometry import SeamMesh, seam_mesh
from scenes.people.glasses import Glasses, glasses_topology
from scenes.variant import keeping_variant, load_mitsuba, single_threaded
from uika.errors import UikaError
from uika.head import Camera, HeadModel

Light = Literal["studio", "environment", "flat", "side", "portrait"]
LIGHTS = ("studio", "environment", "flat", "side", "portrait")
INTEGRATORS = ("direct", "path")
_FOLDER = Path(__file__).parent / "library"
_BSDF = "head.bsdf.brdf_0"
_DEFAULT_ALBEDO = (0.55, 0.36, 0.28)  # linear; an even skin tone
_DEFAULT_ROUGHNESS = 0.55
_SKY = ((0.95, 1.0, 1.1), (0.35, 0.33, 0.3))  # linear radiance at the zenith and below the horizon


@dataclass(frozen=True, eq=False)
class HeadScene:
    """A scene file loaded for one head and image size."""

    scene: Any
    params: Any
    mesh: SeamMesh
    light: Light
    plain_lights: dict[str, Any] = field(default_factory=dict)  # what the scene file says of lamps that were changed

    @property
    def sensor(self) -> Any:
        """The scene's only sensor."""
        return self.scene.sensors()[0]

    def shape(self, name: str) -> Any | None:
        """The shape of that name; None where the scene has none."""
        return next((shape for shape in self.scene.shapes() if shape.id() == name), None)

    def update(
        self,
        head: HeadModel,
        vertices: torch.Tensor,
        camera: Camera,
        texture: np.ndarray | None,
        roughness: np.ndarray | None = None,
        glasses: Glasses | None = None,
    ) -> None:
        """Set vertices [V,3] in metres, camera, linear texture [S,S,3] and roughness [S,S]; None for even skin."""
        self.dress(texture, roughness)
        self._aim(camera)
        self.pose(head, vertices, camera.position, glasses)

    def dress(self, texture: np.ndarray | None, roughness: np.ndarray | None) -> None:
        """Set linear colours [S,S,3] and roughness [S,S] in [0,1], None for even ones; takes effect with `pose`."""
        albedo = np.full((2, 2, 3), _DEFAULT_ALBEDO, np.float32) if texture is None else texture
        if self.light == "flat":
            self._set("head.emitter.radiance.data", albedo)
            return
        rough = np.full((2, 2), _DEFAULT_ROUGHNESS, np.float32) if roughness is None else roughness
        self._set(f"{_BSDF}.base_color.data", albedo)
        self._set(f"{_BSDF}.roughness.data", rough[..., None])

    @keeping_variant()
    def pose(
        self,
        head: HeadModel,
        vertices: torch.Tensor,
        eye: torch.Tensor | None = None,
        glasses: Glasses | None = None,
    ) -> None:
        """Set head vertices [V,3] in metres and glasses, shaded for a viewer at `eye` [3], and apply all changes."""
        bent = eye is not None and "head.vertex_normals" in self.params
        normals = self.mesh.normals(vertices, head.faces, eye) if bent and eye is not None else None
        self._set("head.vertex_positions", self.mesh.positions(vertices))
        if normals is not None:
            self._set("head.vertex_normals", normals)
        self._place_glasses(vertices, glasses)
        with single_threaded():
            self.params.update()
        # Mitsuba tells distant lamps the size of the scene one update late; they aim shadow rays with it, and a picture
        # must not depend on what stood here before.
        for emitter in self.scene.emitters():
            emitter.set_scene(self.scene)

    def _place_glasses(self, vertices: torch.Tensor, glasses: Glasses | None) -> None:
        if "glasses.vertex_positions" in self.params:
            hidden = vertices.mean(0).expand(len(glasses_topology()[0]), 3).numpy()
            self._set("glasses.vertex_positions", hidden if glasses is None else glasses.points)

    def set_lights(self, values: Mapping[str, np.ndarray]) -> None:
        """Set the lamps by their `mi.traverse` names, all others as the scene file has them; takes effect with `pose`.

        Args:
            values: colours [3], transforms [4,4] or pictures [H,W,3] of the size that the scene holds, all linear.

        Raises:
            ValueError: the scene has no such parameter.
        """
        for name in values:
            if name not in self.params:
                raise ValueError(f"the scene '{self.light}' has no parameter '{name}'")
            self.plain_lights.setdefault(name, _copied(self.params[name]))
        for name, plain in self.plain_lights.items():
            _assign(self.params, name, _copied(plain))
        for name, value in values.items():
            if value.ndim == 3:
                # The scene keeps a few columns more, which repeat the first ones.
                missing = self.params[name].shape[1] - value.shape[1]
                self._set(name, np.pad(value, ((0, 0), (0, missing), (0, 0)), mode="wrap"))
            else:
                kind = type(self.params[name])
                _assign(self.params, name, kind(value.tolist()) if value.ndim == 1 else kind(value))

    @keeping_variant()
    def _aim(self, camera: Camera) -> None:
        mi = load_mitsuba()
        for name, number in _sensor_values(camera).items():
            _assign(self.params, f"sensor.{name}", number)
        _assign(self.params, "sensor.to_world", mi.ScalarTransform4f(_sensor_to_world(camera)))

    def _set(self, key: str, array: np.ndarray) -> None:
        kind = type(self.params[key])
        values = aligned(array.astype(np.float32))
        self.params[key] = kind(values if kind.__name__.startswith("Tensor") else values.ravel())


@lru_cache(maxsize=8)
@keeping_variant()
def load_head_scene(head: HeadModel, width: int, height: int, light: Light, integrator: str) -> HeadScene:
    """Load a scene file once for each head, image size, light and integrator.

    Raises:
        ValueError: the light or the integrator is unknown.
    """
    if light not in LIGHTS or integrator not in INTEGRATORS:
        raise ValueError(
            f"light must be one of {LIGHTS} and integrator of {INTEGRATORS}, not {light!r}, {integrator!r}"
        )
    mi = load_mitsuba()
    mesh = seam_mesh(head)
    # Scene files take meshes and textures by file name only; the files are read at once and can go. Pictures as .pfm:
    # where there is one core, Mitsuba 3.9 waits for ever on threads that unpack .exr files.
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files = {"mesh": folder / "head.ply", "texture": folder / "texture.pfm"}
        _write_mesh(head.template.numpy()[mesh.source], mesh.faces, mesh.texcoords, files["mesh"])
        mi.Bitmap(np.full((2, 2, 3), _DEFAULT_ALBEDO, np.float32)).write(str(files["texture"]))
        if light != "flat":
            files |= {"glasses": folder / "glasses.ply", "roughness": folder / "roughness.pfm"}
            _write_mesh(*glasses_topology(), None, files["glasses"])
            mi.Bitmap(np.full((2, 2, 1), _DEFAULT_ROUGHNESS, np.float32)).write(str(files["roughness"]))
        if light == "environment":
            files["environment"] = folder / "environment.pfm"
            mi.Bitmap(plain_sky()).write(str(files["environment"]))
        scene = mi.load_file(
            str(_FOLDER / f"{light}.xml"),
            width=str(width),
            height=str(height),
            integrator=integrator,
            **{key: str(path) for key, path in files.items()},
        )
    return HeadScene(scene, mi.traverse(scene), mesh, light)


def plain_sky(height: int = 32) -> np.ndarray:
    """A bright upper and a darker lower half as a latitude-longitude picture [H,2H,3], linear."""
    up = np.cos(np.pi * (np.arange(height) + 0.5) / height)[:, None, None]
    share = 1 / (1 + np.exp(-4 * up))
    picture = share * np.array(_SKY[0]) + (1 - share) * np.array(_SKY[1])
    return np.ascontiguousarray(np.broadcast_to(picture, (height, 2 * height, 3)), np.float32)


def _copied(value: Any) -> Any:
    """A parameter's value with storage of its own."""
    return type(value)(value)


def _assign(params: Any, key: str, value: Any) -> None:
    # Plain item assignment first compares with the old value, which fails for scalar variants' Python numbers.
    target, kind, _, _ = params.properties[key]
    params.set_dirty(key)
    params.set_property(target, kind, value)


def _write_mesh(positions: np.ndarray, faces: np.ndarray, texcoords: np.ndarray | None, path: Path) -> None:
    import trimesh

    # The normals' values are set with every pose; without them the loaded mesh would have no place for any.
    mesh = trimesh.Trimesh(positions, faces, vertex_normals=np.zeros_like(positions), process=False)
    if texcoords is not None:
        mesh.vertex_attributes.update({name: texcoords[:, axis] for axis, name in enumerate("uv")})
    try:
        mesh.export(path, vertex_normal=True)
    except OSError as error:
        folder = tempfile.gettempdir()
        raise UikaError(f"{folder}: a temporary mesh cannot be written; free space or set TMPDIR ({error})") from error


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
