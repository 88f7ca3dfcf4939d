"""The inputs that a splatting pipeline is known to break on, by number; tests named `test_NN_...` hold them."""

from __future__ import annotations

LINES = {
    1: "quaternion of length 0 or 1e-10: the identity, no gradient",
    2: "quaternion of length 1e-3 or 1e3: same image, gradient with the normalisation",
    3: "scales as logarithms: the chain factor is there",
    4: "a scale of 1e-8: finite gradients",
    5: "needle of aspect 1e4 at 45°: its conic does not cancel",
    6: "disc seen edge-on: culled alike in both passes",
    7: "gradient through the conic's off-diagonal entry",
    8: "centre at, behind or one step beyond the near plane",
    9: "splats far beside the frustum: clamped Jacobian and its derivative",
    10: "principal point anywhere",
    11: "opacities 0, about 1/255, and 1",
    12: "opacity above the clamp: the gradient stops there",
    13: "30,000 splats behind each other",
    14: "opaque stack: both passes stop at the same splat",
    15: "faint splats after the last contributor",
    16: "background gradient counts every pixel once",
    17: "exponents whose sign rounding could turn; splats of 1e20",
    18: "NaN or infinity anywhere: refused by name and index",
    19: "no splat, none visible, one visible",
    20: "more pairs than memory: refused before allocation",
    21: "counting and listing agree on every pair",
    22: "1, 3, 4 and 32 channels",
    23: "sizes that are no multiple of a tile",
    24: "shuffled splats make the same image",
    25: "zoom by 0.1 and 10",
    26: "coordinates of an 8K image",
    27: "popping along an orbit",
    28: "bits between runs and numbers of threads",
    29: "gradients that are strided, expanded, transposed or sliced",
    30: "other number types; nothing that asks for gradients",
    31: "memory over 200 optimisation steps",
    32: "inputs edited between the passes: autograd's error",
    33: "rotations near zero: finite gradients",
    34: "texture coordinates that are NaN or out of range",
    35: "confidence of empty and of uniform counts",
    36: "triangles without area",
    37: "expressions at 5 σ, jaw open 40°, head turned by 180°",
    38: "1 to 64 views, in another order, repeated",
    39: "photos of nothing, of 48 megapixels, of every mode",
    40: "a loss that is not finite: the step is skipped, the checkpoint stays sound",
}

# Tests outside of this folder, or without the number in their name.
ELSEWHERE = {
    28: ["tests/stress/test_workers.py::test_threads_may_call_at_once"],
    39: ["tests/photo/test_read.py"],
    40: ["tests/train/test_train.py::test_a_step_that_is_not_finite_is_skipped_and_named"],
}
