"""The highlight model and the sample patterns of `scenes.deferred`."""

from __future__ import annotations

from typing import Any

import numpy as np

_SPECULAR = 0.035  # reflectance of skin and hair at normal incidence


def highlight(normal: Any, view: Any, mean: Any, diffuse: Any, rough: Any) -> Any:
    """Microfacet reflection (GGX, Walter et al. 2007) of light that comes from around one mean direction."""
    import drjit as dr

    normal = dr.normalize(normal)
    length = dr.norm(mean)
    toward = mean / dr.maximum(length, 1e-4)
    # An even sky has a mean direction of length 2/3.
    directness = dr.clip(3 * length - 2, 0.0, 1.0)
    half = dr.normalize(toward + view)
    # A spread source shows a lobe as wide as itself.
    a = dr.clip(rough * rough + 0.35 * (1 - directness), 0.02, 1.0)
    square = a * a
    nh = dr.maximum(dr.dot(normal, half), 0.0)
    nl = dr.maximum(dr.dot(normal, toward), 0.05)
    nv = dr.maximum(dr.dot(normal, view), 0.05)
    spread = nh * nh * (square - 1) + 1
    lobe = square / (dr.pi * spread * spread)
    k = a / 2
    masking = 1 / ((nl * (1 - k) + k) * (nv * (1 - k) + k))
    fresnel = _SPECULAR + (1 - _SPECULAR) * (1 - dr.maximum(dr.dot(half, view), 0.0)) ** 5
    # What comes from all around is reflected as from an even room (Schlick's term, weakened by roughness).
    even = _SPECULAR + (dr.maximum(1 - rough, _SPECULAR) - _SPECULAR) * (1 - nv) ** 5
    return diffuse * (directness * dr.pi * 0.25 * lobe * masking * fresnel + (1 - directness) * even)


def pixel_pattern(spp: int) -> list[tuple[float, float]]:
    """Points of a pixel: a square grid turned so that each sits in a row and a column of its own."""
    side = round(spp**0.5)
    return [
        ((u + (v + 0.5) / side) / side, (v + (side - u - 0.5) / side) / side) for v in range(side) for u in range(side)
    ]


def plane_points(count: int, seed: int) -> np.ndarray:
    """Low-discrepancy points [N,2] in [0,1) (the R2 sequence), shifted by a seeded offset."""
    plastic = 1.324717957244746
    steps = np.array([1 / plastic, 1 / plastic**2])
    shift = np.random.default_rng(seed).random(2)
    return ((shift + np.arange(1, count + 1)[:, None] * steps) % 1).astype(np.float32)
