from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from drjit_splat import rasterization, reference
from drjit_splat._inputs import Splats
from drjit_splat._settings import Options, Settings
from drjit_splat.constants import T_CLOSING
from drjit_splat.frames import Frame, project_frame
from tests.drjit_splat.common import random_scene

SIZE = (61, 47)


def flat(values: Tensor) -> Any:
    from drjit.llvm import Float

    return Float(values.flatten().numpy())


def picture(
    scene: dict[str, Tensor], size: tuple[int, int] = SIZE, like: Frame | None = None, closing: float = T_CLOSING
) -> Frame:
    names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
    projected = project_frame(*(flat(scene[name]) for name in names), *size, closing)
    return projected.blend(flat(scene["backgrounds"]), like)


@pytest.mark.parametrize("closing", [0.0, T_CLOSING, 0.3])
def test_bytes_are_the_oracles_rounded(closing: float) -> None:
    width, height = SIZE
    scene = random_scene(width=width, height=height)
    depths = rasterization(**scene, width=width, height=height, packed=False)[2]["depths"]
    double = {name: value.double() for name, value in scene.items()}
    order = torch.argsort(depths, dim=-1, stable=True)
    options = Options(transmittance_min=closing) if closing else Options()
    settings = Settings(width, height, options=options, closing=closing > 0)
    image, _, meta = reference.images(Splats(**double), settings, order, None)
    levels = 255 * image[0].clamp(0, 1).numpy()
    trusted = (meta["margin"][0] > 1e-4).numpy()
    error = np.abs(picture(scene, closing=closing).numpy() - levels)[trusted]
    assert trusted.mean() > 0.95 and error.max() < 0.5 + 1e-3
    assert error.mean() > 0.2  # of values that are rounded, a quarter


@pytest.mark.parametrize("size", [(64, 64), (8, 4), (7, 5), (1, 1), (130, 3)])
def test_every_size_is_that_of_the_torch_interface(size: tuple[int, int]) -> None:
    width, height = size
    scene = random_scene(width=width, height=height)
    image = rasterization(**scene, width=width, height=height)[0][0]
    bytes_ = picture(scene, size, closing=0.0).numpy()
    assert bytes_.shape == (height, width, 3)
    assert np.abs(bytes_ - 255 * image.clamp(0, 1).numpy()).max() <= 0.5 + 1e-3


def test_a_closed_pixel_is_off_by_what_was_left_at_most() -> None:
    scene = random_scene(count=400, width=SIZE[0], height=SIZE[1])
    scene["opacities"] = scene["opacities"].clamp(0.5, 0.9)
    full, closed = (picture(scene, closing=t).numpy().astype(int) for t in (0.0, 0.1))
    lowest, highest = scene["colors"].min(), scene["colors"].max()
    contrast = float(
        torch.maximum(highest, scene["backgrounds"].max()) - torch.minimum(lowest, scene["backgrounds"].min())
    )
    assert 1 < np.abs(full - closed).max() <= 255 * 0.1 * contrast + 1


def test_the_differentiable_call_does_not_close_pixels() -> None:
    scene = random_scene(count=20)
    with pytest.raises(TypeError, match="closing"):
        rasterization(**scene, width=8, height=8, closing=True)
    with pytest.raises(ValueError, match="closing"):
        picture(scene, closing=1.0)


def test_an_earlier_picture_changes_no_pixel() -> None:
    scenes = [random_scene(width=SIZE[0], height=SIZE[1], seed=seed) for seed in range(3)]
    alone = [picture(scene).numpy() for scene in scenes]
    last = None
    for scene, wanted in zip(scenes, alone, strict=True):
        last = picture(scene, like=last)
        assert np.array_equal(last.numpy(), wanted)
    assert np.array_equal(picture(scenes[0]).numpy(), alone[0])


def test_frames_may_overlap() -> None:
    scenes = [random_scene(width=SIZE[0], height=SIZE[1], seed=seed) for seed in range(2)]
    names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
    projected = [project_frame(*(flat(scene[name]) for name in names), *SIZE) for scene in scenes]
    pictures = [e.blend(flat(s["backgrounds"])) for e, s in zip(projected, scenes, strict=True)]
    for found, scene in zip(pictures, scenes, strict=True):
        assert np.array_equal(found.numpy(), picture(scene).numpy())


def test_nothing_in_view_leaves_the_background() -> None:
    scene = random_scene(count=20)
    scene["means"][:, 2] -= 100
    found = picture(scene).numpy()
    assert (found == np.round(255 * scene["backgrounds"][0].numpy()).astype(np.uint8)).all()


def test_values_that_are_not_finite_are_refused() -> None:
    scene = random_scene(count=20)
    scene["scales"][3, 1] = torch.nan
    with pytest.raises(ValueError, match="finite"):
        picture(scene)
