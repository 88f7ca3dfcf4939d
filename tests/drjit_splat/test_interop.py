"""Calls that cross between torch and Dr.Jit by `drjit.wrap`: the bridge, and those that users compose."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from drjit_splat import Options, rasterization
from drjit_splat.llvm import require

require()

import drjit as dr  # noqa: E402
from drjit.llvm.ad import TensorXf  # noqa: E402

from drjit_splat import drjit_api, interop  # noqa: E402

from .common import random_scene  # noqa: E402

SIZE = {"width": 32, "height": 24}


def leaves(cameras: int = 1) -> dict[str, Tensor]:
    return {k: v.requires_grad_() for k, v in random_scene(count=100, cameras=cameras, **SIZE).items()}


def test_both_bridges_carry_the_same_bits() -> None:
    found = []
    for bridge in ("wrap", "direct"):
        scene = leaves(cameras=2)
        image, alpha, meta = rasterization(**scene, **SIZE, render_mode="RGB+D", options=Options(bridge=bridge))
        meta["conics"].retain_grad()
        (image.square().sum() + alpha.sum() + meta["conics"].sum()).backward()
        found.append([image, alpha, meta["conics"].grad, *(leaf.grad for leaf in scene.values())])
    assert Options().bridge == "wrap"
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))
    with pytest.raises(ValueError, match="bridge"):
        Options(bridge="dlpack")


def test_the_wrapped_call_is_the_torch_call() -> None:
    scene, other = leaves(cameras=2), leaves(cameras=2)
    image, alpha = interop.rasterization(**scene, **SIZE, rasterize_mode="antialiased")
    expected, covered, _ = rasterization(**other, **SIZE, rasterize_mode="antialiased")
    assert torch.allclose(image, expected, atol=1e-6) and torch.equal(alpha, covered)
    weight = torch.randn(2, 32, 24, 3, generator=torch.Generator().manual_seed(0)).transpose(1, 2)  # strided
    image.backward(weight)
    expected.backward(weight)
    for name, leaf in scene.items():
        assert leaf.grad is not None and other[name].grad is not None
        assert float((leaf.grad - other[name].grad).norm()) <= 1e-5 * float(other[name].grad.norm()), name


def test_a_second_backward_pass_is_refused_where_the_bare_wrap_repeats_the_first() -> None:
    scene = leaves()
    bare = dr.wrap(source="torch", target="drjit")(drjit_api.rasterization)
    image = bare(**scene, **SIZE)[0]
    red, green = (torch.autograd.grad(image[..., k].sum(), scene["means"], retain_graph=True)[0] for k in (0, 1))
    assert torch.equal(red, green)  # the trap
    image = interop.rasterization(**scene, **SIZE)[0]
    torch.autograd.grad(image[..., 0].sum(), scene["means"], retain_graph=True)
    with pytest.raises(RuntimeError, match="second backward pass"):
        torch.autograd.grad(image[..., 1].sum(), scene["means"], retain_graph=True)


def test_edited_and_empty_tensors_are_refused_and_parameters_taken() -> None:
    scene = {name: value.detach() for name, value in leaves().items()}
    colors = torch.nn.Parameter(scene["colors"])
    image = interop.rasterization(**(scene | {"colors": colors}), **SIZE)[0]
    image.sum().backward()
    assert colors.grad is not None and colors.grad.any()
    image = interop.rasterization(**(scene | {"colors": colors}), **SIZE)[0]
    with torch.no_grad():
        colors.mul_(2)
    with pytest.raises(RuntimeError, match="inplace"):
        image.sum().backward()
    with pytest.raises(ValueError, match="empty"):
        interop.rasterization(**(scene | {"means": scene["means"][:0]}), **SIZE)


def test_nested_arguments_and_results() -> None:
    def both(values: dict[str, Any], factors: list[Any], power: int) -> dict[str, Any]:
        return {"sum": values["a"] + factors[0], "product": [values["a"] * factors[0] ** power]}

    a, b = torch.rand(4, requires_grad=True), torch.rand(4, requires_grad=True)
    found = interop.as_torch(both)({"a": a}, [b], power=2)
    assert torch.allclose(found["product"][0], a * b**2)
    (found["sum"].sum() + found["product"][0].sum()).backward()
    assert a.grad is not None and b.grad is not None
    assert torch.allclose(a.grad, 1 + b.detach() ** 2) and torch.allclose(b.grad, 1 + 2 * (a * b).detach())


def test_a_torch_network_inside_drjit() -> None:
    torch.manual_seed(0)
    network = torch.nn.Linear(3, 3)
    scene = random_scene(count=60, **SIZE)
    tensors = {k: TensorXf(v.numpy()) for k, v in scene.items()}
    dr.enable_grad(tensors["means"])
    colors = interop.as_drjit(network.forward)(tensors["means"])
    image = drjit_api.rasterization(**(tensors | {"colors": colors}), **SIZE)[0]
    dr.backward(dr.sum(dr.square(image)))
    means = scene["means"].clone().requires_grad_()
    twin = torch.nn.Linear(3, 3)
    twin.load_state_dict(network.state_dict())
    rasterization(**(scene | {"means": means, "colors": twin(means)}), **SIZE)[0].square().sum().backward()
    assert means.grad is not None
    found = torch.from_numpy(dr.grad(tensors["means"]).numpy().copy())
    assert float((found - means.grad).norm()) <= 1e-5 * float(means.grad.norm())
    for ours, theirs in zip(network.parameters(), twin.parameters(), strict=True):
        assert ours.grad is not None and theirs.grad is not None
        assert torch.allclose(ours.grad, theirs.grad, rtol=1e-4, atol=1e-4)
