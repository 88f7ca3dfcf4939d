"""The public rasterizer."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ._function import Splat, Trace
from ._harmonics import colors_seen_from
from ._inputs import Settings, Splats, check_finite, check_shapes, finish
from ._project import CULLED, RECORD


def rasterization(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [N, D] or [N, K, D]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,  # [C, D]
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians from C cameras; differentiable in every tensor argument.

    Args:
        means: [N, 3] centres in world units (metres).
        quats: [N, 4] rotations, wxyz, of any length; too short ones count as the identity and get no gradient.
        scales: [N, 3] standard deviations in world units (not logarithms).
        opacities: [N] in [0, 1] (not logits).
        colors: [N, D] with 1 <= D <= 32, or spherical harmonics [N, K, D] when `sh_degree` is given.
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

    Returns:
        colors [C, H, W, D (+ 1 with a depth)], alphas [C, H, W, 1] in the dtype of `means`, and meta: `means2d`
        [C, N, 2] pixels, `depths` [C, N], `radii` [C, N, 2] pixels (0 where culled), `visible` [C, N], and a list with
        one entry a camera for `n_visible`, `n_pairs` ((tile, splat) pairs) and `n_culled` (splats by reason, and
        `occluded_pairs` that the early stop never touched).

    Raises:
        ValueError: an argument has a wrong shape, type or value, or holds a NaN or an infinity.
        MemoryError: the splats cover more tiles than can be stored.
        RuntimeError: no LLVM library (CPU) or CUDA driver was found; the message says what to install.
    """
    settings = Settings(
        width, height, near_plane, far_plane, radius_clip, eps2d, sh_degree, render_mode, rasterize_mode
    )
    given = Splats(means, quats, scales, opacities, colors, viewmats, Ks, backgrounds)
    check_shapes(given, settings)
    if sh_degree is not None or not settings.has_colors:
        check_finite(colors=colors)  # the projection kernel checks everything that it reads itself
    single = Splats(*(None if t is None else t.to(torch.float32) for t in vars(given).values()))  # type: ignore[arg-type]
    images, coverages, traces = [], [], []
    for i in range(len(viewmats)):
        values = single.colors
        if not settings.has_colors:
            values = single.means.new_zeros(len(means), 0)
        elif sh_degree is not None:
            values = colors_seen_from(single.colors, single.means, single.viewmats[i], sh_degree)
        holder: list[Trace] = []
        tensors = (single.means, single.quats, single.scales, single.opacities, values)
        sums, coverage = Splat.apply(settings, holder, *tensors, single.viewmats[i], single.Ks[i])
        background = None if single.backgrounds is None else single.backgrounds[i]
        images.append(finish(sums, coverage, background, settings))
        coverages.append(coverage)
        traces.append(holder[0])
    dtype = means.dtype
    return _stack(images).to(dtype), _stack(coverages).to(dtype), _meta(traces, means)


def _stack(parts: list[Tensor]) -> Tensor:
    return parts[0][None] if len(parts) == 1 else torch.stack(parts)


def _meta(traces: list[Trace], means: Tensor) -> dict[str, Any]:
    n, device = len(means), means.device
    found: dict[str, list[Any]] = {key: [] for key in ("means2d", "depths", "radii", "visible")}
    visible, pairs, culled = [], [], []
    for trace in traces:
        p = trace.projected
        if p is None:
            found["means2d"].append(torch.zeros(n, 2, device=device))
            found["depths"].append(torch.zeros(n, device=device))
            found["radii"].append(torch.zeros(n, 2, dtype=torch.int32, device=device))
            found["visible"].append(torch.zeros(n, dtype=torch.bool, device=device))
            visible.append(0)
            pairs.append(0)
            culled.append({reason: 0 for reason in CULLED if reason} | {"occluded_pairs": 0})
            continue
        found["means2d"].append(p.records.torch().view(n, RECORD)[:, :2])
        found["depths"].append(p.depths.torch())
        found["radii"].append(p.radii.torch().view(n, 2))
        found["visible"].append(p.visible.torch())
        visible.append(n - sum(p.culled.values()))
        pairs.append(p.pairs)
        culled.append(p.culled | {"occluded_pairs": trace.passed_over})
    meta: dict[str, Any] = {key: _stack(parts) for key, parts in found.items()}
    return meta | {"n_visible": visible, "n_pairs": pairs, "n_culled": culled}
