"""The public rasterizer."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ._autograd import rasterize
from ._backend import exclusive
from ._call import call_for
from ._compat import check_compatibility
from ._compile import outside_graphs
from ._harmonics import colors_seen_from
from ._inputs import Splats, check_finite, check_shapes, finish
from ._meta import Meta, describe
from ._settings import Options, Settings
from .constants import MAX_CHECKED
from .profiling import stage


@outside_graphs
@exclusive
def rasterization(
    means: Tensor,  # [..., N, 3]
    quats: Tensor | None,  # [..., N, 4]
    scales: Tensor | None,  # [..., N, 3]
    opacities: Tensor,  # [..., N]
    colors: Tensor | None,  # [..., (C,) N, D] or [..., (C,) N, K, D]
    viewmats: Tensor,  # [..., C, 4, 4]
    Ks: Tensor,  # [..., C, 3, 3]
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int | None = 16,
    backgrounds: Tensor | None = None,  # [..., C, D]
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,  # [..., N, 3, 3]
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,  # [..., C, 4]
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
    *,
    semantics: str = "gsplat",
    options: Options | None = None,
    **newer: Any,
) -> tuple[Tensor, Tensor, Meta]:
    """Render N Gaussians from C cameras; differentiable in every tensor argument. `...` are batch dimensions.

    Args:
        means: [..., N, 3] centres in world units (metres).
        quats: [..., N, 4] rotations, wxyz, of any length; too short ones count as the identity and get no gradient.
        scales: [..., N, 3] standard deviations in world units (not logarithms).
        opacities: [..., N] in [0, 1] (not logits).
        colors: [..., N, D] with any number of channels, or harmonics [..., N, K, D] when `sh_degree` is given;
            a set for each camera where C comes before N. Harmonics [N, K, D] may serve a whole batch. None where no
            colours are rendered.
        viewmats: [..., C, 4, 4] world-to-camera, OpenCV axes (x right, y down, z forward).
        Ks: [..., C, 3, 3] pinhole matrices in pixels, without skew; pixel centres lie at +0.5.
        width: pixels.
        height: pixels.
        near_plane: splats whose centre is not beyond this depth are culled.
        far_plane: splats whose centre is not before this depth are culled.
        radius_clip: splats whose extent is at most this many pixels are culled.
        eps2d: variance (pixels^2) added to every splat on the image plane.
        sh_degree: None for plain colours, else 0 to 4.
        packed: whether meta lists visible splats only, row by row (it changes neither images nor speed).
        tile_size: pixels, of the tiles that meta speaks of (the kernels have tiles of their own).
        backgrounds: [..., C, D] colours behind the splats; none behind a depth channel.
        render_mode: "RGB", "D" (sum of weighted depths), "ED" (divided by the coverage), "RGB+D" or "RGB+ED".
        sparse_grad: whether means, quats and scales get sparse gradients (of packed calls without batch dimensions).
        absgrad: whether the backward pass leaves `meta["means2d"].absgrad`, the sums over the pixels of the absolute
            gradients of the means on the image (Ye et al. 2024, AbsGS); for up to 8 channels, depth included.
        rasterize_mode: "classic", or "antialiased" to scale opacities against the area that `eps2d` adds.
        channel_chunk: ignored, as `segmented`.
        distributed: must be False, as `with_ut` and `with_eval3d`.
        camera_model: "pinhole", "ortho" (K in pixels a world unit) or "fisheye" (equidistant).
        segmented: ignored.
        covars: [..., N, 3, 3] covariances in place of `quats` and `scales`, which are then not looked at; read as the
            mean of the matrix and its transpose.
        with_ut: must be False.
        with_eval3d: must be False.
        radial_coeffs: [..., C, 4] OpenCV's k1 to k4 of a fisheye lens, without gradients.
        tangential_coeffs: must be None, as the five that follow (`rolling_shutter` may name the global one).
        thin_prism_coeffs: must be None.
        ftheta_coeffs: must be None.
        rolling_shutter: must be None or global.
        viewmats_rs: must be None.
        semantics: "gsplat", or "inria" for the rules of the original 3DGS rasterizer: nothing nearer than 0.2, opacity
            held at 0.99, footprints cut at three deviations (on 16-pixel tiles), Jacobian clamped about the axis.
        options: accuracy and skips, see `Options`.
        newer: arguments of gsplat 1.6, at their defaults.

    Returns:
        colors [..., C, H, W, D (+ 1 with a depth)], alphas [..., C, H, W, 1] in the dtype of `means`, and meta.

        Meta is a dict whose values are made when somebody looks: `means2d` [..., C, N, 2] pixels, `conics`
        [..., C, N, 3] (xx, xy, yy of the inverse covariance) and `depths` [..., C, N], which stand in the graph between
        splats and images; `radii` [..., C, N, 2] pixels (0 where culled) and `opacities` [..., C, N], detached. If
        `packed`, all these have one row a visible splat, [nnz, ...], whose `batch_ids`, `camera_ids` and `gaussian_ids`
        are given. Further gsplat's `tiles_per_gauss`, `isect_ids`, `flatten_ids`, `isect_offsets`, `tile_*`,
        `n_batches`, `n_cameras`, `width` and `height`; and, of this rasterizer alone, `visible` [..., C, N] and lists
        with one entry an image for `n_visible`, `n_pairs` ((tile, splat) pairs) and `n_culled` (splats by reason, and
        `occluded_pairs` that the early stop never touched).

    Raises:
        ValueError: an argument has a wrong shape, type or value, or holds a NaN or an infinity, or asks for something
            that is not available.
        TypeError: there is no such argument.
        MemoryError: the splats cover more tiles than can be stored.
        RuntimeError: no LLVM library (CPU) or CUDA driver was found; the message says what to install.
    """
    check_compatibility(
        newer
        | {
            "distributed": distributed,
            "with_ut": with_ut,
            "with_eval3d": with_eval3d,
            "tangential_coeffs": tangential_coeffs,
            "thin_prism_coeffs": thin_prism_coeffs,
            "ftheta_coeffs": ftheta_coeffs,
            "rolling_shutter": rolling_shutter,
            "viewmats_rs": viewmats_rs,
        }
    )
    settings = Settings.of(
        width,
        height,
        options,
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        eps2d=eps2d,
        sh_degree=sh_degree,
        render_mode=render_mode,
        rasterize_mode=rasterize_mode,
        semantics=semantics,
        camera_model=camera_model,
    )
    if covars is not None:
        quats = scales = None
    given = Splats(means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, covars, radial_coeffs)
    check_shapes(given, settings)
    tiles = 16 if tile_size is None else tile_size
    if not 1 <= tiles <= 65536:
        raise ValueError(f"tile_size must be an integer from 1 to 65536, not {tile_size!r}")
    channels = _channels(given, settings)
    if absgrad and channels + settings.has_depth > 8:
        raise ValueError(f"absgrad=True is available for up to 8 channels, depth included, not {channels}")
    sparse = sparse_grad and packed
    if sparse and len(given.batch):
        raise ValueError("sparse_grad=True is available without batch dimensions only")
    if given.colors is not None and (sh_degree is not None or not settings.has_colors or channels > MAX_CHECKED):
        check_finite(colors=given.colors)  # the projection kernel checks everything that it reads itself
    with torch.autocast(means.device.type, enabled=False):
        single = given.to(torch.float32)
        splats = single.batches(settings)
        seen = [_colors(s, camera, settings) for s in splats for camera in range(viewmats.shape[-3])]
        call = call_for(
            means.device,
            settings,
            tuple(given.batch),
            viewmats.shape[-3],
            packed=packed,
            sparse=sparse,
            absgrad=absgrad,
            wrapped=settings.options.bridge == "wrap",
        )
        per_splat = [t for s in splats for t in (s.means, s.quats, s.scales, s.covars, s.opacities)]
        radial = None if single.radial_coeffs is None else single.radial_coeffs.reshape(call.count, 4)
        cameras = single.viewmats.reshape(call.count, 4, 4), single.Ks.reshape(call.count, 3, 3), radial
        sums, coverage, *between = rasterize(call, (*per_splat, *cameras), seen)
        behind = None
        if settings.has_colors and single.backgrounds is not None:
            behind = single.backgrounds.reshape(call.count, 1, 1, -1)
        image = finish(sums, coverage, behind, settings)
    shape = (*given.batch, call.cameras)
    dtype, n = means.dtype, means.shape[-2]
    meta = describe(call, n, means.device, tuple(between), tiles)
    return image.view(*shape, *image.shape[1:]).to(dtype), coverage.view(*shape, *coverage.shape[1:]).to(dtype), meta


def _channels(given: Splats, settings: Settings) -> int:
    return given.colors.shape[-1] if settings.has_colors and given.colors is not None else 0


def _colors(splats: Splats, camera: int, settings: Settings) -> Tensor:
    """Colours [N, D] that one camera sees."""
    if not settings.has_colors:
        return splats.means.new_zeros(len(splats.means), 0)
    values = splats.colors_of(camera, settings)
    if settings.sh_degree is None:
        return values
    with stage("harmonics"):
        return colors_seen_from(values, splats.means, splats.viewmats[camera], settings.sh_degree)
