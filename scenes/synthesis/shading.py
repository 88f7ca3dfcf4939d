"""The highlight model, transfer curve and sample patterns of `scenes.synthesis.deferred`."""

from __future__ import annotations

from typing import Any

import numpy as np

# Samples per pixel -> rings around the centre: points, radius in pixels and degrees of the first point. Their spread is
# about that of a pixel's whole area.
_RINGS = {1: (), 4: ((3, 0.43, 15.0),), 16: ((5, 0.27, 10.0), (10, 0.46, 4.0))}
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


def encode_srgb(value: Any) -> Any:
    """Linear values as sRGB in [0,1], on the device (IEC 61966-2-1)."""
    import drjit as dr

    v = dr.clip(value, 0.0, 1.0)
    return dr.select(v <= 0.0031308, 12.92 * v, 1.055 * dr.power(v, 1 / 2.4) - 0.055)


def pixel_pattern(spp: int) -> list[tuple[float, float]]:
    """Points of a pixel: its centre, where labels are taken, and rings around it.

    The points' mean is the centre and no two share a row or a column.

    Raises:
        ValueError: there is no pattern of that many points.
    """
    if spp not in _RINGS:
        raise ValueError(f"spp must be one of {tuple(_RINGS)}, not {spp}")
    points = [(0.5, 0.5)]
    for count, radius, turn in _RINGS[spp]:
        angles = np.deg2rad(turn) + 2 * np.pi * np.arange(count) / count
        points += [(0.5 + radius * float(np.cos(a)), 0.5 + radius * float(np.sin(a))) for a in angles]
    return points


def plane_points(count: int, seed: int) -> np.ndarray:
    """Low-discrepancy points [N,2] in [0,1) (the R2 sequence), shifted by a seeded offset."""
    plastic = 1.324717957244746
    steps = np.array([1 / plastic, 1 / plastic**2])
    shift = np.random.default_rng(seed).random(2)
    return ((shift + np.arange(1, count + 1)[:, None] * steps) % 1).astype(np.float32)
