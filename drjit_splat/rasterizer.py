"""The public rasterizer."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ._autograd import Splat
from ._backend import exclusive
from ._compat import check_compatibility
from ._core import Trace
from ._harmonics import colors_seen_from
from ._inputs import Splats, check_finite, check_shapes, finish
from ._meta import Meta, describe, stack
from ._settings import Options, Settings
from .profiling import stage


@exclusive
def rasterization(
    means: Tensor,  # [N, 3]
    quats: Tensor | None,  # [N, 4]
    scales: Tensor | None,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [(C,) N, D] or [(C,) N, K, D]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    *,
    backgrounds: Tensor | None = None,  # [C, D]
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    covars: Tensor | None = None,  # [N, 3, 3]
    semantics: str = "gsplat",
    options: Options | None = None,
    **compatibility: Any,
) -> tuple[Tensor, Tensor, Meta]:
    """Render N Gaussians from C cameras; differentiable in every tensor argument.

    Args:
        means: [N, 3] centres in world units (metres).
        quats: [N, 4] rotations, wxyz, of any length; too short ones count as the identity and get no gradient.
        scales: [N, 3] standard deviations in world units (not logarithms).
        opacities: [N] in [0, 1] (not logits).
        colors: [N, D] with 1 <= D <= 32, or spherical harmonics [N, K, D] when `sh_degree` is given; a set for each
            camera where C comes first.
        viewmats: [C, 4, 4] world-to-camera, OpenCV axes (x right, y down, z forward).
        Ks: [C, 3, 3] pinhole matrices in pixels, without skew; pixel centres lie at +0.5.
        width: pixels.
        height: pixels.
        near_plane: splats whose centre is not beyond this depth are culled.
        far_plane: splats whose centre is not before this depth are culled.
        radius_clip: splats whose extent is at most this many pixels are culled.
        eps2d: variance (pixels^2) added to every splat on the image plane.
        sh_degree: None for plain colours, else 0 to 3.
        backgrounds: [C, D] colours behind the splats; none behind a depth channel.
        render_mode: "RGB", "D" (sum of weighted depths), "ED" (divided by the coverage), "RGB+D" or "RGB+ED".
        rasterize_mode: "classic", or "antialiased" to scale opacities against the area that `eps2d` adds.
        covars: [N, 3, 3] covariances in place of `quats` and `scales`, which are then not looked at; read as the mean
            of the matrix and its transpose.
        semantics: "gsplat", or "inria" for the rules of the original 3DGS rasterizer: nothing nearer than 0.2, opacity
            held at 0.99, footprints cut at three deviations (on 16-pixel tiles), Jacobian clamped about the axis.
        options: accuracy and skips, see `Options`.
        compatibility: gsplat's other arguments; those that cannot change the image are ignored.

    Returns:
        colors [C, H, W, D (+ 1 with a depth)], alphas [C, H, W, 1] in the dtype of `means`, and meta, a mapping with
        `means2d` [C, N, 2] pixels, `depths` [C, N], `conics` [C, N, 3] (xx, xy, yy of the inverse covariance),
        `opacities` [C, N], `radii` [C, N, 2] pixels (0 where culled), `visible` [C, N], and lists with one entry a
        camera for `n_visible`, `n_pairs` ((tile, splat) pairs) and `n_culled` (splats by reason, and `occluded_pairs`
        that the early stop never touched).

    Raises:
        ValueError: an argument has a wrong shape, type or value, or holds a NaN or an infinity.
        MemoryError: the splats cover more tiles than can be stored.
        RuntimeError: no LLVM library (CPU) or CUDA driver was found; the message says what to install.
    """
    check_compatibility(compatibility)
    settings = Settings(
        width,
        height,
        near_plane,
        far_plane,
        radius_clip,
        eps2d,
        sh_degree,
        render_mode,
        rasterize_mode,
        semantics,
        options or Options(),
    )
    if covars is not None:
        quats = scales = None
    given = Splats(means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, covars)
    check_shapes(given, settings)
    if sh_degree is not None or not settings.has_colors:
        check_finite(colors=colors)  # the projection kernel checks everything that it reads itself
    single = given.to(torch.float32)
    images, coverages, traces = [], [], []
    for i in range(len(viewmats)):
        values = single.colors_of(i, settings)
        if not settings.has_colors:
            values = single.means.new_zeros(len(means), 0)
        elif sh_degree is not None:
            with stage("harmonics"):
                values = colors_seen_from(values, single.means, single.viewmats[i], sh_degree)
        holder: list[Trace] = []
        tensors = (single.means, single.quats, single.scales, single.covars, single.opacities, values)
        sums, coverage = Splat.apply(settings, holder, *tensors, single.viewmats[i], single.Ks[i])
        background = None if single.backgrounds is None else single.backgrounds[i]
        images.append(finish(sums, coverage, background, settings))
        coverages.append(coverage)
        traces.append(holder[0])
    dtype = means.dtype
    return stack(images).to(dtype), stack(coverages).to(dtype), describe(traces, len(means), means.device)
