"""`gaussian_splats`: a Mitsuba integrator that draws splats among the meshes of a scene.

    <integrator type="gaussian_splats">
        <string name="filename" value="me.safetensors"/>
        <integrator type="path"/>
    </integrator>

The file is an avatar, or a splat scene (.ply, .spz). The nested integrator (`direct` when none is given) draws the
meshes. A splat is drawn when no mesh hides its centre, and what is drawn covers the meshes behind; light does not pass
from one to the other.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from scenes.colour import srgb_to_linear
from scenes.variant import FAST_VARIANT, keeping_variant, load_mitsuba

NAME = "gaussian_splats"


class SplatView(NamedTuple):
    """A sensor as splats are projected, OpenCV axes."""

    viewmat: Tensor  # [4,4] world to camera
    K: Tensor  # [3,3] pixels, or pixels a unit
    width: int
    height: int
    model: Literal["pinhole", "ortho"]


@lru_cache(maxsize=1)
@keeping_variant()
def register_plugins() -> None:
    """Make `gaussian_splats` known to Mitsuba, once.

    Raises:
        RuntimeError: Mitsuba cannot run its fast variant here.
    """
    mi = load_mitsuba()
    if mi.variant() != FAST_VARIANT:
        raise RuntimeError(f"the integrator '{NAME}' needs Mitsuba's {FAST_VARIANT}; install LLVM 16 or newer")
    mi.register_integrator(NAME, lambda props: _integrator_class(mi)(props))


@lru_cache(maxsize=1)
def _integrator_class(mi: Any) -> Any:
    import drjit as dr

    class GaussianSplats(mi.ad.integrators.common.ADIntegrator):
        """See the module; `mi.traverse` shows the arrays of the splats, flat, which can be differentiated.

        `means` [N * 3], `quats` [N * 4] wxyz, `scales` [N * 3], `opacities` [N], and either `colors` [N * 3], linear,
        of an avatar or `harmonics` [N * K * 3] of a splat scene, whose colours are sRGB.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.shapes, values = _load(props["filename"])
            self.values = {name: mi.Float(value.numpy().ravel()) for name, value in values.items()}
            nested = [props[name] for name in props.keys() if isinstance(props[name], mi.Integrator)]  # noqa: SIM118
            self.meshes = nested[0] if nested else mi.load_dict({"type": "direct"})

        def traverse(self, callback: Any) -> None:
            for name, value in self.values.items():
                callback.put(name, value, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: Any) -> None:
            del keys

        def render(self, scene: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0, *_: Any, **__: Any) -> Any:
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            behind = self.meshes.render(scene, sensor, seed, spp, True, True)
            with torch.no_grad():
                splats, left = self._splats(scene, sensor, self._tensors())
            return _over(mi, behind, splats, left)

        def render_backward(
            self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
        ) -> None:
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            tensors = self._tensors()
            for name, tensor in tensors.items():
                tensor.requires_grad_(dr.grad_enabled(self.values[name]))
            splats, left = self._splats(scene, sensor, tensors)
            grad = torch.from_numpy(np.array(grad_in))
            if any(tensor.requires_grad for tensor in tensors.values()):
                behind = torch.from_numpy(np.array(self.meshes.render(scene, sensor, seed, spp, True, True)))
                # What lies behind a splat shines through it, so that its opacity counts there too.
                shown = splats + left * behind[..., :3]
                loss = (shown * grad[..., :3]).sum()
                if grad.shape[-1] > 3:
                    loss = loss + ((1 - left * (1 - behind[..., 3:4])) * grad[..., 3:4]).sum()
                loss.backward()
            for name, tensor in tensors.items():
                if tensor.grad is not None:
                    dr.accum_grad(self.values[name], mi.Float(np.ascontiguousarray(tensor.grad.numpy()).ravel()))
            others = [value for name, value in params.items() if name.rpartition(".")[2] not in self.values]
            if not any(dr.grad_enabled(value) for value in others):
                return
            through = mi.TensorXf((grad * left.detach()).numpy())
            self.meshes.render_backward(scene, params, through, sensor, seed, spp)

        def render_forward(self, *_: Any, **__: Any) -> Any:
            raise NotImplementedError(f"the integrator '{NAME}' differentiates in reverse mode only")

        def _tensors(self) -> dict[str, Tensor]:
            return {name: _torch(value).view(self.shapes[name]) for name, value in self.values.items()}

        def _splats(self, scene: Any, sensor: Any, given: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
            """Colour [H,W,3] of the visible splats, and what they let through, [H,W,1]."""
            from drjit_splat import rasterization

            view = opencv_view(mi, sensor)
            visible = _before_meshes(mi, scene, given["means"].detach(), view)
            opacities = torch.where(visible, given["opacities"], 0.0)
            colors = given["colors"] if "colors" in given else _seen(given["harmonics"], given["means"], view)
            image, alpha, _ = rasterization(
                given["means"],
                given["quats"],
                given["scales"],
                opacities,
                colors,
                view.viewmat[None],
                view.K[None],
                view.width,
                view.height,
                camera_model=view.model,
                packed=False,
            )
            return image[0], 1 - alpha[0]

        def to_string(self) -> str:
            return f"GaussianSplats[{self.shapes['opacities'][0]} splats, {self.meshes}]"

    return GaussianSplats


def _load(path: str) -> tuple[dict[str, tuple[int, ...]], dict[str, Tensor]]:
    """Shapes and values of a file's splats."""
    kind = Path(path).suffix.lower()
    if kind in (".ply", ".sog", ".splat", ".spz"):
        from drjit_splat import load_splats

        values = dict(vars(load_splats(path)))
    else:
        from uika.avatar import Avatar

        avatar = Avatar.load(path)
        values = {name: getattr(avatar, name) for name in ("means", "quats", "scales", "opacities")}
        values["colors"] = torch.from_numpy(srgb_to_linear(avatar.colors.numpy()))
    return {name: tuple(value.shape) for name, value in values.items()}, values


def _seen(harmonics: Tensor, means: Tensor, view: SplatView) -> Tensor:
    """Linear colours [N,3] of sRGB harmonics [N,K,3] seen by a camera."""
    from drjit_splat import sh_colors

    degree = round(harmonics.shape[1] ** 0.5) - 1
    if view.model == "ortho":
        # All rays are parallel: the directions are those from a point infinitely far behind the camera.
        forward = view.viewmat[2, :3]
        eye = -1e6 * forward
    else:
        eye = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
    srgb = sh_colors(harmonics, torch.nn.functional.normalize(means - eye, dim=-1), degree).clamp(0, 1)
    curve = ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(srgb <= 0.04045, srgb / 12.92, curve)


def _torch(values: Any) -> Tensor:
    import drjit as dr

    return torch.from_numpy(np.array(dr.detach(values), copy=True))


def _over(mi: Any, behind: Any, splats: Tensor, left: Tensor) -> Any:
    """The developed mesh image [H,W,3 or 4] under the splats."""
    meshes = torch.from_numpy(np.array(behind))
    image = splats + left * meshes[..., :3]
    if meshes.shape[-1] > 3:
        image = torch.cat((image, 1 - left * (1 - meshes[..., 3:4])), -1)
    return mi.TensorXf(np.ascontiguousarray(image.numpy()))


def opencv_view(mi: Any, sensor: Any) -> SplatView:
    """The view of a perspective or orthographic sensor, see `scenes.head_scene`.

    Raises:
        ValueError: the sensor is another one.
    """
    params = mi.traverse(sensor)
    ortho = str(sensor).startswith("OrthographicCamera")
    if not ortho and ("x_fov" not in params or "principal_point_offset_x" not in params):
        raise ValueError(f"the integrator '{NAME}' needs a perspective or an orthographic sensor")
    width, height = (int(value) for value in sensor.film().crop_size())
    to_world = np.array(params["to_world"].matrix, np.float64).reshape(4, 4) @ np.diag([-1.0, -1.0, 1.0, 1.0])
    if ortho:
        # The film is two units wide before the sensor's own scale.
        size = np.linalg.norm(to_world[:3, :3], axis=0)
        to_world[:3, :3] /= size
        focal = width / (2 * size[:2])
        centre = [width / 2, height / 2]
    else:
        fov, shift_x, shift_y = (
            float(np.array(params[name]).ravel()[0])
            for name in ("x_fov", "principal_point_offset_x", "principal_point_offset_y")
        )
        focal = np.full(2, width / (2 * np.tan(np.deg2rad(fov) / 2)))
        centre = [width * (0.5 - shift_x), height * 0.5 - shift_y * height]
    K = torch.tensor([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]], dtype=torch.float32)
    viewmat = torch.from_numpy(np.linalg.inv(to_world)).float()
    return SplatView(viewmat, K, width, height, "ortho" if ortho else "pinhole")


def _before_meshes(mi: Any, scene: Any, means: Tensor, view: SplatView) -> Tensor:
    """Which splat centres [N] no mesh hides."""
    if view.model == "ortho":
        depth = means @ view.viewmat[2, :3] + view.viewmat[2, 3]
        toward = depth[:, None] * view.viewmat[2, :3]
        eye = means - toward
    else:
        eye = (-(view.viewmat[:3, :3].T @ view.viewmat[:3, 3])).expand_as(means)
        toward = means - eye
    origin, direction = (np.ascontiguousarray(vectors.T.numpy()) for vectors in (eye, toward))
    ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
    ray.maxt = 1.0 - 1e-4
    return torch.from_numpy(~np.array(scene.ray_test(ray)))
