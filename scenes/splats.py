"""`gaussian_splats`: a Mitsuba integrator that draws an avatar's splats among the meshes of a scene.

    <integrator type="gaussian_splats">
        <string name="filename" value="me.avatar"/>
        <integrator type="path"/>
    </integrator>

The nested integrator (`direct` when none is given) draws the meshes. A splat is drawn when no mesh hides its centre,
and what is drawn covers the meshes behind; light does not pass from one to the other.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scenes.colour import srgb_to_linear
from scenes.variant import FAST_VARIANT, keeping_variant, load_mitsuba

NAME = "gaussian_splats"


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
        """See the module; `mi.traverse` shows `colors`, linear, flat [N * 3], which can be differentiated."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            avatar = _load(props["filename"])
            self.means, self.quats, self.scales, self.opacities = avatar[:4]
            self.colors = mi.Float(np.ascontiguousarray(srgb_to_linear(avatar[4].numpy())).ravel())
            nested = [props[name] for name in props.keys() if isinstance(props[name], mi.Integrator)]  # noqa: SIM118
            self.meshes = nested[0] if nested else mi.load_dict({"type": "direct"})

        def traverse(self, callback: Any) -> None:
            callback.put("colors", self.colors, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: Any) -> None:
            del keys

        def render(self, scene: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0, *_: Any, **__: Any) -> Any:
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            behind = self.meshes.render(scene, sensor, seed, spp, True, True)
            with torch.no_grad():
                splats, left = self._splats(scene, sensor, _torch(self.colors).view(-1, 3))
            return _over(mi, behind, splats, left)

        def render_backward(
            self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
        ) -> None:
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            colors = _torch(self.colors).view(-1, 3).requires_grad_()
            splats, left = self._splats(scene, sensor, colors)
            grad = torch.from_numpy(np.array(grad_in))
            splats.backward(grad[..., :3])
            if colors.grad is not None and dr.grad_enabled(self.colors):
                dr.accum_grad(self.colors, mi.Float(colors.grad.numpy().ravel()))
            others = [value for name, value in params.items() if not name.endswith("colors")]
            if not any(dr.grad_enabled(value) for value in others):
                return
            through = mi.TensorXf((grad * left.detach()).numpy())
            self.meshes.render_backward(scene, params, through, sensor, seed, spp)

        def render_forward(self, *_: Any, **__: Any) -> Any:
            raise NotImplementedError(f"the integrator '{NAME}' differentiates in reverse mode only")

        def _splats(self, scene: Any, sensor: Any, colors: Tensor) -> tuple[Tensor, Tensor]:
            """Colour [H,W,3] of the visible splats, and what they let through, [H,W,1]."""
            from drjit_splat import rasterization

            viewmat, K, width, height = _opencv(mi, sensor)
            visible = _before_meshes(mi, scene, self.means, viewmat)
            opacities = torch.where(visible, self.opacities, 0.0)
            image, alpha, _ = rasterization(
                self.means, self.quats, self.scales, opacities, colors, viewmat[None], K[None], width, height
            )
            return image[0], 1 - alpha[0]

        def to_string(self) -> str:
            return f"GaussianSplats[{len(self.means)} splats, {self.meshes}]"

    return GaussianSplats


def _load(path: str) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    from uika.avatar import Avatar

    avatar = Avatar.load(path)
    return avatar.means, avatar.quats, avatar.scales, avatar.opacities, avatar.colors


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


def _opencv(mi: Any, sensor: Any) -> tuple[Tensor, Tensor, int, int]:
    """Matrices and size of a perspective sensor, see `scenes.head_scene`."""
    params = mi.traverse(sensor)
    if "x_fov" not in params or "principal_point_offset_x" not in params:
        raise ValueError(f"the integrator '{NAME}' needs a perspective sensor")
    width, height = (int(value) for value in sensor.film().crop_size())
    to_world = np.array(params["to_world"].matrix, np.float64).reshape(4, 4)
    viewmat = np.linalg.inv(to_world @ np.diag([-1.0, -1.0, 1.0, 1.0]))
    fov, shift_x, shift_y = (
        float(np.array(params[name]).ravel()[0])
        for name in ("x_fov", "principal_point_offset_x", "principal_point_offset_y")
    )
    focal = width / (2 * np.tan(np.deg2rad(fov) / 2))
    K = [[focal, 0, width * (0.5 - shift_x)], [0, focal, height * 0.5 - shift_y * height], [0, 0, 1]]
    return torch.from_numpy(viewmat).float(), torch.tensor(K), width, height


def _before_meshes(mi: Any, scene: Any, means: Tensor, viewmat: Tensor) -> Tensor:
    """Which splat centres [N] no mesh hides."""
    eye = -(viewmat[:3, :3].T @ viewmat[:3, 3])
    toward = means - eye
    ray = mi.Ray3f(mi.Point3f(eye.tolist()), mi.Vector3f(np.ascontiguousarray(toward.T.numpy())))
    ray.maxt = 1.0 - 1e-4
    return torch.from_numpy(~np.array(scene.ray_test(ray)))
