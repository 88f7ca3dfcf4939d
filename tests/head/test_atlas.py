import pytest
import torch

from tests.heads import released_parity
from tests.recorded import recorded
from uika.head import HeadModel, HeadParameters, skin_points, surface_points, uv_texels


def texel_uv(head: HeadModel, triangle: torch.Tensor, barycentric: torch.Tensor) -> torch.Tensor:
    uv = (head.uvs[head.uv_faces[triangle]] * barycentric[..., None]).sum(1)
    return torch.stack((uv[:, 0], 1 - uv[:, 1]), 1)


def test_texel_centres_map_back_to_themselves(head: HeadModel) -> None:
    binding = uv_texels(head, 48)
    torch.testing.assert_close(texel_uv(head, binding.triangle, binding.barycentric), binding.uv, atol=1e-5, rtol=0)
    assert bool((binding.texel.diff() > 0).all())
    assert uv_texels(head, 48) is binding


def test_top_rows_are_the_top_of_the_head(head: HeadModel) -> None:
    binding = uv_texels(head, 48)
    points = surface_points(head.template, head.faces, binding)
    assert float(points[:50, 1].mean()) > 0.08 > -0.08 > float(points[-50:, 1].mean())


def test_released_rule_keeps_a_subset(head: HeadModel) -> None:
    ours, released = uv_texels(head, 40), uv_texels(head, 40, "released")
    assert len(released) < len(ours)
    assert bool(ours.valid[released.valid].all())


def test_maps_and_points_convert_both_ways(head: HeadModel) -> None:
    binding = uv_texels(head, 32)
    values = torch.randn(2, len(binding), 3)
    image = binding.to_map(values, fill=-1.0)
    assert image.shape == (2, 3, 32, 32)
    assert bool((image[:, :, ~binding.valid] == -1).all())
    assert torch.equal(binding.from_map(image), values)
    with pytest.raises(ValueError, match="needs 32x32"):
        binding.from_map(torch.zeros(3, 16, 16))


def test_unknown_rule_is_refused(head: HeadModel) -> None:
    with pytest.raises(ValueError, match="rule"):
        uv_texels(head, 8, "loose")  # type: ignore[arg-type]


@recorded
def test_released_texels_and_gaussian_path() -> None:
    data, head = released_parity()
    binding = uv_texels(head, 40, "released")
    assert torch.equal(binding.texel, data["w/valid_mask_flatten"].nonzero()[:, 0])
    assert torch.equal(binding.triangle, data["w/pix_to_face_flatten"])
    torch.testing.assert_close(binding.barycentric, data["w/pix_bary_flatten"], atol=2e-6, rtol=0)
    canonical = surface_points(head.template, head.faces, binding)
    torch.testing.assert_close(canonical, data["out/cano_zero"][0], atol=1e-6, rtol=0)

    names = ("expr", "rotation", "neck", "jaw", "eyes", "translation")
    params = HeadParameters(torch.zeros(3, 20), *(data[f"in/{name}"] for name in names))
    posed = skin_points(canonical + data["in/offset"], head, params, binding)
    torch.testing.assert_close(posed, data["out/gs_animated"], atol=1e-6, rtol=0)
