"""Numbers that the kernels, their adjoints and the float64 oracle must share: a mismatch biases gradients silently."""

from __future__ import annotations

import math

LOG2E = math.log2(math.e)
"""Exponents count in powers of two: exp(x) = 2 ** (LOG2E x)."""

SH_C0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / sqrt(4 pi): a colour is 0.5 + SH_C0 times its first coefficient."""

ALPHA_MIN = 1.0 / 255.0
"""A (pixel, splat) pair below one 8-bit step is skipped; it also bounds each splat's footprint."""

ALPHA_MAX = 0.999
"""Opacity clamp: keeps 1 - alpha away from zero, which the backward pass divides by."""

ALPHA_MAX_INRIA = 0.99
"""The same clamp under `semantics="inria"`, the rules of the original 3DGS rasterizer."""

NEAR_INRIA = 0.2
"""Depth up to which that rasterizer culls, whatever the scene's unit."""

TILE_INRIA = 16
"""Its tiles (pixels): a splat reaches every tile that its square of three standard deviations touches."""

EIGENVALUE_FLOOR_INRIA = 0.1
"""Least squared half-difference of a footprint's two variances (pixels^4) in that rasterizer's radius."""

T_MIN = 1e-4
"""Blending stops before the splat that would bring the transmittance to this value or below."""

T_CLOSING = 1.0 / 255.0
"""The same for pictures in bytes, where the splat at which a pixel stops gets all that is left of its transmittance: no
channel is off by more than this times the contrast of what lies behind."""

FRUSTUM_MARGIN = 0.3
"""Share of tan(field of view / 2) beyond the image at which x/z and y/z are clamped inside the projection's
Jacobian (1.3 tan in all); further out the affine approximation would smear one splat over the whole image."""

QUAT_MIN_NORM = 1e-8
"""Shorter quaternions have no usable direction: they stand for the identity rotation and get no gradient."""

DET_MIN = 1e-12
"""Smallest determinant (pixels^4) of a projected covariance that can be inverted in float32. With the default
eps2d every determinant is >= 0.09, so this only culls splats when the low-pass is switched off."""

DET_MAX = 1e30
"""Largest such determinant: beyond it (a splat 10 million pixels wide) float32 products overflow."""

OPACITY_FLOOR = 2.0**-100
"""Least opacity whose logarithm is taken; far below every threshold."""

COMPENSATION_MIN = 1e-10
"""Floor of the determinant ratio under the antialiasing square root, whose slope is infinite at zero. At the floor
an opacity is multiplied by 1e-5 and the splat is culled, so no visible splat is changed by it."""

CUT_SLACK = 2e-3
"""log2 units added to a splat's footprint threshold, so that rounding in the conservative tile test never drops a
pixel that the exact per-pixel test would keep."""

MAX_CHECKED = 32
"""Most colour channels whose finiteness the projection kernel checks in passing; more are checked before."""

MAX_PAIRS = 2**31 - 1
"""Most (tile, splat) pairs of one image: indices are 32 bit."""
