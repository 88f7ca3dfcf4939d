import io

import numpy as np
import pytest
from PIL import Image

from uika.data.encode import UV_STEPS, decode_colour, decode_depth, decode_uv, encode_pixels, encode_uv
from uika.errors import UikaError


@pytest.mark.parametrize(("shape", "kind"), [((7, 5, 3), np.uint8), ((7, 5), np.uint8), ((1, 9), np.uint16)])
def test_other_programs_read_the_same_pixels(shape: tuple[int, ...], kind: type) -> None:
    pixels = np.random.default_rng(0).integers(0, np.iinfo(kind).max + 1, shape).astype(kind)
    image = Image.open(io.BytesIO(encode_pixels(pixels)))
    assert image.format == "PNG" and image.mode == {3: "RGB"}.get(len(shape), "L" if kind is np.uint8 else "I;16")
    np.testing.assert_array_equal(np.array(image), pixels)


def test_correspondences_return_to_a_step() -> None:
    uv = np.random.default_rng(1).random((6, 8, 2)).astype(np.float32)
    steps = (uv * UV_STEPS + 1.5).astype(np.uint16)
    steps[0, 0] = 0
    found, valid = decode_uv(encode_uv(steps), "a.png")
    assert not valid[0, 0] and valid.sum() == 47
    np.testing.assert_allclose(found[valid], uv[valid], atol=0.6 / UV_STEPS)


def test_files_of_another_kind_are_named() -> None:
    eight = encode_pixels(np.zeros((4, 4), np.uint8))
    with pytest.raises(UikaError, match=r"depth\.png: is not a 16-bit image"):
        decode_depth(eight, "depth.png")
    with pytest.raises(UikaError, match=r"odd\.png: is not a correspondence image"):
        decode_uv(encode_pixels(np.zeros((3, 4), np.uint16)), "odd.png")
    with pytest.raises(UikaError, match=r"torn\.png: is not a readable image"):
        decode_colour(eight[:40], "torn.png")
