"""The third result: gsplat's dict, its values in the graph, and nothing of it where nobody looks."""

from __future__ import annotations

import copy
import io
import pickle
from collections import OrderedDict
from typing import Any

import pytest
import torch
from torch import Tensor

from drjit_splat import rasterization, reference

from .common import random_scene

KEYS = {
    *("batch_ids", "camera_ids", "gaussian_ids", "radii", "means2d", "depths", "conics", "opacities"),
    *("tile_width", "tile_height", "tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets"),
    *("width", "height", "tile_size", "n_batches", "n_cameras"),
}
SIZE = {"width": 48, "height": 40}


def leaves_of(scene: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.clone().requires_grad_() for name, value in scene.items()}


def scene(cameras: int = 2, count: int = 120) -> dict[str, Tensor]:
    return random_scene(count=count, cameras=cameras, **SIZE)


def oracle_gradients(given: dict[str, Tensor], weight: Tensor, **options: Any) -> dict[str, Tensor]:
    """Gradients of the oracle's image by its projected means, conics and depths [C, N, ...], from its own parts."""
    settings = reference.settings_of(48, 40, None, options)
    double = {name: value.double() for name, value in given.items()}
    splats = reference.Splats(**double)
    found: dict[str, list[Tensor]] = {"means2d": [], "conics": [], "depths": []}
    order = rasterization(**given, **SIZE, packed=False, **options)[2]["depths"].argsort(dim=-1, stable=True)
    for i, view in enumerate(splats.viewmats):
        p = reference.project(splats, view, splats.Ks[i], settings)
        xx, xy, yy = p.covariance.unbind(-1)
        conics = (torch.stack([yy, -xy, xx], -1) / p.determinant[:, None]).detach().requires_grad_()
        means2d, depths = p.means2d.detach().requires_grad_(), p.depths.detach().requires_grad_()
        a, b, d = conics.unbind(-1)
        determinant = 1 / (a * d - b * b)
        moved = reference.Projection(
            means2d,
            depths,
            torch.stack([d, -b, a], -1) * determinant[:, None],
            determinant,
            p.opacities,
            *(getattr(p, name) for name in ("drawable", "visible", "margin", "radii", "span")),
        )
        features = torch.cat([splats.colors, depths[:, None]], -1)
        sums, _, _, margin = reference.blend(moved, features, settings, order[i], None)
        trusted = (margin > 1e-4)[..., None]
        grads = torch.autograd.grad((sums * weight[i] * trusted).sum(), [means2d, conics, depths])
        weight[i] *= trusted
        for name, gradient in zip(found, grads, strict=True):
            found[name].append(gradient)
    return {name: torch.stack(parts) for name, parts in found.items()}


def test_it_is_gsplats_dict() -> None:
    meta = rasterization(**scene(), **SIZE)[2]
    assert isinstance(meta, dict)
    assert meta.keys() >= KEYS
    assert (meta["width"], meta["height"], meta["n_cameras"], meta["n_batches"]) == (48, 40, 2, 1)
    assert (meta["tile_width"], meta["tile_height"], meta["tile_size"]) == (3, 3, 16)
    plain = dict(meta)
    assert type(plain) is dict and plain["means2d"] is meta["means2d"] and {**meta}["radii"] is meta["radii"]
    assert meta.get("nothing", 3) == 3 and "nothing" not in meta
    assert meta.pop("width") == 48 and "width" not in meta and meta.pop("width", 5) == 5
    meta["mine"] = 1
    meta.update({"means2d": 2})
    assert (meta["mine"], meta["means2d"]) == (1, 2) and dict(meta.items())["means2d"] == 2
    with pytest.raises(KeyError):
        meta["nothing"]


def test_copies_are_detached() -> None:
    meta = rasterization(**leaves_of(scene()), **SIZE)[2]
    file = io.BytesIO()
    torch.save(meta, file)
    file.seek(0)
    for found in (pickle.loads(pickle.dumps(meta)), torch.load(file), copy.deepcopy(meta)):
        assert type(found) is OrderedDict and list(found) == list(meta)
        assert torch.equal(found["means2d"], meta["means2d"]) and not found["means2d"].requires_grad


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("names", [("means2d",), ("means2d", "conics", "depths")])
def test_gradients_in_between_are_the_oracles(packed: bool, names: tuple[str, ...]) -> None:
    given = scene()
    del given["backgrounds"]
    weight = torch.randn(2, 40, 48, 4, generator=torch.Generator().manual_seed(1)).double()
    wanted = oracle_gradients(given, weight, render_mode="RGB+D")
    leaves = leaves_of(given)
    image, _, meta = rasterization(**leaves, **SIZE, packed=packed, render_mode="RGB+D")
    for name in names:
        meta[name].retain_grad()
    image.backward(weight.float())
    visible = meta["visible"]
    for name in names:
        found = meta[name].grad
        want = wanted[name][visible] if packed else wanted[name] * visible.view(*visible.shape, *[1] * (found.ndim - 2))
        assert found.shape == want.shape
        assert float((found - want).norm()) <= 5e-5 * float(want.norm()), name
    untouched = leaves_of(given)
    rasterization(**untouched, **SIZE, render_mode="RGB+D")[0].backward(weight.float())
    for name, leaf in leaves.items():  # on a busy machine threads add up in another order
        want = untouched[name].grad
        assert torch.allclose(leaf.grad, want, rtol=1e-5, atol=1e-6 * float(want.abs().max())), name  # type: ignore


def test_losses_on_the_values_in_between_reach_the_splats() -> None:
    given, weight = scene(), {}
    leaves, double = leaves_of(given), {k: v.double().requires_grad_() for k, v in given.items()}
    image, _, meta = rasterization(**leaves, **SIZE, packed=False)
    settings = reference.settings_of(48, 40, None, {})
    loss, wanted = image.sum() * 0, torch.zeros(()).double()
    for name in ("means2d", "conics", "depths"):
        weight[name] = torch.randn(meta[name].shape, generator=torch.Generator().manual_seed(2))
        mask = meta["visible"].view(*meta["visible"].shape, *[1] * (meta[name].ndim - 2))
        loss = loss + (meta[name] * weight[name] * mask).sum()
    for i, view in enumerate(double["viewmats"]):
        p = reference.project(reference.Splats(**double), view, double["Ks"][i], settings)
        xx, xy, yy = p.covariance.unbind(-1)
        values = {"means2d": p.means2d, "depths": p.depths}
        values["conics"] = torch.stack([yy, -xy, xx], -1) / p.determinant[:, None]
        for name, value in values.items():
            seen = meta["visible"][i]
            assert torch.allclose(meta[name][i][seen].double(), value[seen], rtol=1e-4, atol=1e-4)
            mask = seen.view(-1, *[1] * (value.ndim - 1))
            wanted = wanted + (value * weight[name][i].double() * mask).sum()
    loss.backward()
    wanted.backward()
    for name in ("means", "quats", "scales", "viewmats", "Ks"):
        found, want = leaves[name].grad, double[name].grad
        assert found is not None and want is not None
        assert float((found - want).norm()) <= 1e-4 * float(want.norm()), name


def test_asking_for_a_gradient_in_between_alone_disturbs_no_later_pass() -> None:
    leaves = leaves_of(scene())
    image, _, meta = rasterization(**leaves, **SIZE, packed=False)
    torch.autograd.grad(image.sum(), meta["means2d"], retain_graph=True)
    alone = torch.autograd.grad(meta["means2d"].sum(), leaves["means"], retain_graph=True)[0]
    both = torch.autograd.grad(image.sum() + meta["means2d"].sum(), leaves["means"], retain_graph=True)[0]
    image_only = torch.autograd.grad(image.sum(), leaves["means"])[0]
    assert float((alone + image_only - both).norm()) <= 1e-5 * float(both.norm())
    assert float(alone.norm()) > 0


def test_hooks_may_change_what_passes() -> None:
    given = {k: v for k, v in scene().items() if k != "backgrounds"}
    found = []
    for factor in (1.0, 3.0):
        leaves = leaves_of(given)
        image, _, meta = rasterization(**leaves, **SIZE)
        for name in ("means2d", "conics", "depths"):
            meta[name].register_hook(lambda g, factor=factor: factor * g)
        image.sum().backward()
        found.append(leaves["means"].grad)
    assert float((found[1] - 3 * found[0]).norm()) <= 1e-4 * float(found[1].norm())


@pytest.mark.parametrize("packed", [False, True])
def test_absolute_gradients_are_those_of_single_pixels(packed: bool) -> None:
    given = random_scene(count=30, width=12, height=9)
    weight = torch.randn(1, 9, 12, 3, generator=torch.Generator().manual_seed(3))
    image, _, meta = rasterization(**leaves_of(given), width=12, height=9, packed=packed, absgrad=True)
    total, summed = torch.zeros_like(meta["means2d"]), torch.zeros_like(meta["means2d"])
    for y in range(9):
        for x in range(12):
            one = torch.zeros_like(weight)
            one[0, y, x] = weight[0, y, x]
            gradient = torch.autograd.grad(image, meta["means2d"], one, retain_graph=True)[0]
            total, summed = total + gradient.abs(), summed + gradient
    meta["means2d"].retain_grad()
    image.backward(weight)
    means2d: Any = meta["means2d"]
    assert torch.allclose(means2d.absgrad, total, rtol=1e-4, atol=1e-5 * float(total.max()))
    assert torch.allclose(means2d.grad, summed, rtol=1e-3, atol=1e-5 * float(total.max()))
    assert (means2d.absgrad >= means2d.grad.abs() - 1e-5).all()
    with pytest.raises(ValueError, match="absgrad"):
        rasterization(**random_scene(count=3, channels=9), width=8, height=8, absgrad=True)


def test_packed_rows_are_the_visible_splats() -> None:
    given = scene()
    packed, full = (rasterization(**given, **SIZE, packed=p)[2] for p in (True, False))
    rows = full["visible"]
    assert full["gaussian_ids"] is None and full["camera_ids"] is None and full["batch_ids"] is None
    for name in ("means2d", "conics", "depths", "radii", "opacities"):
        assert torch.equal(packed[name], full[name][rows]), name
    camera, splat = rows.nonzero().unbind(-1)
    assert torch.equal(packed["camera_ids"], camera) and torch.equal(packed["gaussian_ids"], splat)
    assert not packed["batch_ids"].any()
    assert torch.equal(packed["isect_offsets"], full["isect_offsets"])
    assert torch.equal(packed["tiles_per_gauss"], full["tiles_per_gauss"][rows])


def test_intersections_are_gsplats() -> None:
    gsplat = pytest.importorskip("gsplat.cuda._torch_impl", reason="skipped: gsplat is not installed")
    meta = rasterization(**scene(count=40), **SIZE, packed=False)[2]
    counts, ids, flat = gsplat._isect_tiles(meta["means2d"], meta["radii"], meta["depths"], 16, 3, 3)
    assert torch.equal(meta["tiles_per_gauss"], counts)
    assert torch.equal(meta["isect_ids"], ids) and torch.equal(meta["flatten_ids"], flat)
    assert torch.equal(meta["isect_offsets"], gsplat._isect_offset_encode(ids, 2, 3, 3))


def test_nothing_visible_has_empty_rows() -> None:
    given = scene()
    given["means"] = given["means"] - 100
    leaves = leaves_of(given)
    image, _, meta = rasterization(**leaves, **SIZE, absgrad=True)
    meta["means2d"].retain_grad()
    image.sum().backward()
    assert meta["means2d"].shape == (0, 2) and meta["isect_ids"].shape == (0,)
    assert meta["means2d"].grad is None or meta["means2d"].grad.shape == (0, 2)
    assert leaves["means"].grad is not None and not leaves["means"].grad.any()
