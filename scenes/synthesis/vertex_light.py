"""Direct light at the vertices of a head: the emitters of a scene file, sampled with shadows."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch

from scenes.arrays import flat
from scenes.head_scene import HeadScene, Light, load_head_scene
from scenes.synthesis.shading import plane_points
from scenes.variant import FAST_VARIANT, keeping_variant, load_mitsuba
from uika.head import HeadModel, vertex_normals

_LIFT = 3e-4  # metres, from the vertex to the point that is lit: clear of its own triangles


@keeping_variant()
def lit_scene(head: HeadModel, light: Light) -> HeadScene:
    """A scene for `Shader`, which needs no image size, with the lamps of the scene file."""
    head_scene = _used_scene(head, light)
    head_scene.set_lights({})
    return head_scene


@lru_cache(maxsize=8)
def _used_scene(head: HeadModel, light: Light) -> HeadScene:
    """A scene that has been used once.

    Kernels that meet freshly loaded numbers differ in their last digits from all later ones; the first use goes here.
    """
    require_fast(load_mitsuba())
    head_scene = load_head_scene(head, 16, 16, light, "direct")
    head_scene.pose(head, head.template)
    for _ in range(2):
        gather_light(head_scene, head.template, vertex_normals(head.template, head.faces), 4, 0)
    return head_scene


@keeping_variant()
def gather_light(
    head_scene: HeadScene, points: torch.Tensor, normals: torch.Tensor, samples: int, seed: int
) -> np.ndarray:
    """Direct light at points [N,3] with unit normals [N,3] in a scene.

    All points share one low-discrepancy set of samples: the error is then smooth along the surface, not grainy.

    Returns:
        [N,6]: the radiance that a white diffuse surface would send out, then the mean direction of the light, which is
        shorter than 1 as the light is spread.
    """
    mi = load_mitsuba()
    import drjit as dr

    lane = dr.arange(mi.UInt32, len(points) * samples)
    vertex = lane // dr.opaque(mi.UInt32, samples)
    point, normal = (
        mi.Point3f(*(mi.Float(flat(axis)) for axis in t.numpy().T)) for t in (points + _LIFT * normals, normals)
    )
    set_ = mi.Point2f(*(mi.Float(flat(axis)) for axis in plane_points(samples, seed).T))
    hit = dr.zeros(mi.SurfaceInteraction3f, len(points) * samples)
    hit.p, hit.n = dr.gather(mi.Point3f, point, vertex), mi.Normal3f(dr.gather(mi.Point3f, normal, vertex))
    place = dr.gather(mi.Point2f, set_, lane % dr.opaque(mi.UInt32, samples))
    sample, weight = head_scene.scene.sample_emitter_direction(hit, place, True)
    cosine = dr.maximum(dr.dot(sample.d, hit.n), 0.0)
    light = dr.select(sample.pdf > 0, weight * cosine * (dr.inv_pi / samples), 0.0)
    brightness = mi.luminance(light)
    values = [*light, *(brightness * sample.d), brightness]
    dr.eval(values)  # together: each block sum alone would trace the shadow rays again
    columns = np.stack([np.array(dr.block_sum(value, samples)) for value in values], -1)
    return np.concatenate((columns[:, :3], columns[:, 3:6] / np.maximum(columns[:, 6:], 1e-8)), -1)


def require_fast(mi: Any) -> None:
    """Raise RuntimeError where Mitsuba runs another variant than the fast one."""
    if mi.variant() != FAST_VARIANT:
        raise RuntimeError(f"views with labels need Mitsuba's {FAST_VARIANT}; install LLVM 16 or newer")
