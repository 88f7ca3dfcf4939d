"""Reference images of a posed head: colour, mask, depth, UV and triangle ids."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch

from scenes.colour import linear_to_srgb, srgb_to_linear
from scenes.head_scene import HeadScene, Light, load_head_scene
from scenes.people.glasses import Glasses
from scenes.variant import FAST_VARIANT, keeping_variant, load_mitsuba
from uika.head import Camera, HeadModel

AOVS = ("rgb", "linear", "mask", "depth", "normal", "uv", "triangle")
_TRACED = ("depth", "normal", "uv", "triangle")


@keeping_variant()
def render(
    vertices: torch.Tensor | np.ndarray,
    head: HeadModel,
    camera: Camera,
    texture: torch.Tensor | np.ndarray | None = None,
    aovs: Sequence[str] = ("rgb", "mask", "depth", "uv"),
    spp: int = 16,
    light: Light = "studio",
    *,
    integrator: Literal["direct", "path"] = "direct",
    background: Sequence[float] = (1.0, 1.0, 1.0),
    roughness: torch.Tensor | np.ndarray | None = None,
    glasses: Glasses | None = None,
    seed: int = 0,
) -> dict[str, np.ndarray]:
    """Render a head mesh with Mitsuba; only what `aovs` names is traced.

    Args:
        vertices: [V,3] posed vertices, metres.
        head: the head whose topology and UVs the vertices follow.
        camera: one OpenCV camera with equal focal lengths and no skew.
        texture: sRGB UV map in [0,1] as [3,S,S], [1,S,S] or [S,S,3], row 0 at v = 0 (the top); None for an even
            skin tone.
        aovs: names out of `AOVS`.
        spp: samples per pixel of colour and mask.
        light: "studio" (soft room and three lamps), "environment" (a sky), "side" (one hard lamp), "portrait" (one
            large lamp and a backdrop, which fills the frame behind the head) or "flat" (the texture's own colour,
            unlit).
        integrator: "direct" (one bounce) or "path".
        background: sRGB colour behind the head.
        roughness: UV map [S,S] in [0,1]; None for an even one.
        glasses: what the head wears; no label shows it.
        seed: of the sampler; the same seed gives the same image.

    Returns:
        For each name asked for: "rgb" [H,W,3] sRGB in [0,1]; "linear" [H,W,3] radiance, multiplied by the mask; "mask"
        [H,W] coverage in [0,1] (under "portrait" 0 or 1 at pixel centres); and, taken exactly at pixel centres so that
        values are never mixed at outlines, "depth" [H,W] camera z in metres (0 for none), "normal" [H,W,3] of the
        triangle in world space, towards the camera (0), "uv" [H,W,2] with v down (0) and "triangle" [H,W] int64 (-1).

    Raises:
        ValueError: an argument does not fit; the message names it.
        RuntimeError: depth, uv or triangle is asked for where only `scalar_rgb` can run.
    """
    unknown = set(aovs) - set(AOVS)
    if unknown or spp < 1:
        raise ValueError(f"aovs must be out of {AOVS} and spp at least 1, got {sorted(unknown) or spp}")
    points = _check_vertices(vertices, head)
    _check_camera(camera)
    albedo = None if texture is None else srgb_to_linear(_texture_array(texture))
    head_scene = load_head_scene(head, camera.width, camera.height, light, integrator)
    head_scene.update(
        head, points, camera, albedo, None if roughness is None else np.asarray(roughness, np.float32), glasses
    )
    images: dict[str, np.ndarray] = {}
    backdrop = light == "portrait"
    with_colour = "rgb" in aovs or "linear" in aovs
    if with_colour or ("mask" in aovs and not backdrop):
        images["linear"], images["mask"] = _radiance(head_scene, spp, seed, with_colour)
        images["rgb"] = _composite(images["linear"], images["mask"], background)
    if any(name in aovs for name in _TRACED) or (backdrop and "mask" in aovs):
        images.update(_centre_hits(head_scene, camera))
    if backdrop and "mask" in aovs:
        images["mask"] = (images["triangle"] >= 0).astype(np.float32)
    return {name: images[name] for name in aovs}


def _radiance(head_scene: HeadScene, spp: int, seed: int, with_colour: bool) -> tuple[np.ndarray, np.ndarray]:
    """Linear premultiplied colour [H,W,3] and coverage [H,W]; the colour is meaningless without `with_colour`."""
    mi = load_mitsuba()
    # The depth integrator follows primary rays only and draws the same film positions, so the mask stays the same.
    integrator = head_scene.scene.integrator() if with_colour else mi.load_dict({"type": "depth"})
    image = np.array(mi.render(head_scene.scene, integrator=integrator, spp=spp, seed=seed), dtype=np.float32)
    return image[..., :3], np.clip(image[..., 3], 0, 1)


def _composite(colour: np.ndarray, coverage: np.ndarray, background: Sequence[float]) -> np.ndarray:
    alpha = coverage[..., None]
    surface = linear_to_srgb(colour / np.maximum(alpha, 1e-6))
    return surface * alpha + np.asarray(background, np.float32) * (1 - alpha)


def _centre_hits(head_scene: HeadScene, camera: Camera) -> dict[str, np.ndarray]:
    """Depth, UV and triangle id of the first surface on the ray through each pixel centre."""
    mi = load_mitsuba()
    if mi.variant() != FAST_VARIANT:
        raise RuntimeError(f"depth, uv and triangle images need Mitsuba's {FAST_VARIANT}; install LLVM 16 or newer")
    import drjit as dr

    width, height = camera.width, camera.height
    index = dr.arange(mi.UInt32, width * height)
    position = mi.Point2f((mi.Float(index % width) + 0.5) / width, (mi.Float(index // width) + 0.5) / height)
    ray, _ = head_scene.sensor.sample_ray(0.0, 0.0, position, mi.Point2f(0.5))
    hit = head_scene.scene.ray_intersect(ray, mi.RayFlags.Minimal | mi.RayFlags.UV, coherent=True)
    found = hit.is_valid()
    found &= hit.shape == mi.ShapePtr(head_scene.shape("head"))
    forward = mi.Vector3f(*camera.viewmat[2, :3].double().tolist())
    z = dr.dot(forward, hit.p) + float(camera.viewmat[2, 3])
    depth, u, v = (dr.select(found, value, 0.0) for value in (z, hit.uv.x, hit.uv.y))
    triangle = dr.select(found, mi.Int32(hit.prim_index), -1)
    normal = dr.select(found, dr.mulsign(hit.n, -dr.dot(hit.n, ray.d)), 0.0)
    dr.eval(depth, u, v, triangle, normal)
    return {
        "normal": np.array(normal).T.reshape(height, width, 3),
        "depth": np.array(depth).reshape(height, width),
        "uv": np.stack((np.array(u), np.array(v)), -1).reshape(height, width, 2),
        "triangle": np.array(triangle).astype(np.int64).reshape(height, width),
    }


def _check_vertices(vertices: torch.Tensor | np.ndarray, head: HeadModel) -> torch.Tensor:
    tensor = torch.as_tensor(vertices).detach().cpu().float()
    if tensor.shape != head.template.shape:
        raise ValueError(f"vertices have shape {tuple(tensor.shape)}; this head needs {tuple(head.template.shape)}")
    if not bool(tensor.isfinite().all()):
        raise ValueError("vertices hold values that are not finite")
    return tensor


def _check_camera(camera: Camera) -> None:
    K = camera.K
    if camera.viewmat.ndim != 2 or K.ndim != 2:
        raise ValueError("render takes one camera; index the batch first")
    if abs(float(K[0, 0] - K[1, 1])) > 1e-4 * float(K[0, 0]) or float(K[0, 1]) != 0:
        raise ValueError("Mitsuba's sensor needs square pixels without skew: K[0,0] == K[1,1] and K[0,1] == 0")


def _texture_array(texture: torch.Tensor | np.ndarray) -> np.ndarray:
    array: np.ndarray = torch.as_tensor(texture).detach().cpu().float().numpy()
    if array.ndim == 3 and array.shape[0] in (1, 3):
        array = np.moveaxis(array, 0, -1)
    if array.ndim != 3 or array.shape[0] != array.shape[1] or array.shape[2] not in (1, 3):
        raise ValueError(f"texture has shape {array.shape}; [3,S,S], [1,S,S] or [S,S,3] is needed")
    return np.clip(np.broadcast_to(array, (*array.shape[:2], 3)), 0, 1)
