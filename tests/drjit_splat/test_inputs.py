"""Refused arguments, and how LLVM is found."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from drjit_splat import rasterization
from drjit_splat._binning import available_memory
from drjit_splat.llvm import MIN_VERSION, candidates, library_version, require

from .common import one_splat


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"means": torch.zeros(3)}, "means"),
        ({"quats": torch.zeros(2, 4)}, "quats"),
        ({"scales": torch.zeros(1, 2)}, "scales"),
        ({"opacities": torch.zeros(1, 1)}, "opacities"),
        ({"colors": torch.zeros(1, 0)}, "colors"),
        ({"colors": torch.zeros(1, 3, dtype=torch.int64)}, "colors"),
        ({"viewmats": torch.eye(4)}, "viewmats"),
        ({"Ks": torch.eye(3)}, "Ks"),
        ({"Ks": torch.zeros(1, 3, 3)}, r"Ks\[0\]"),
        ({"backgrounds": torch.zeros(3)}, "backgrounds"),
        ({"width": 0}, "width"),
        ({"height": 2.5}, "height"),
        ({"near_plane": 5.0, "far_plane": 1.0}, "near_plane"),
        ({"eps2d": -1.0}, "eps2d"),
        ({"sh_degree": 5}, "sh_degree"),
        ({"sh_degree": 4, "colors": torch.zeros(1, 16, 3)}, "colors"),
        (
            {"viewmats": torch.eye(4).index_put((torch.tensor(3), torch.tensor(0)), torch.tensor(0.1))[None]},
            r"viewmats\[0\]",
        ),
        ({"camera_model": "ftheta"}, "camera_model"),
        ({"radial_coeffs": torch.zeros(1, 4)}, "radial_coeffs"),
        ({"tile_size": 0}, "tile_size"),
        ({"sh_degree": 2, "colors": torch.zeros(1, 4, 3)}, "colors"),
        ({"render_mode": "depth"}, "render_mode"),
        ({"rasterize_mode": "fast"}, "rasterize_mode"),
    ],
)
def test_a_wrong_argument_is_named(changes: dict[str, Any], named: str) -> None:
    arguments: dict[str, Any] = one_splat() | {"width": 16, "height": 16} | changes
    with pytest.raises(ValueError, match=f"^{named} "):
        rasterization(**arguments)


@pytest.mark.parametrize(
    ("path", "version"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1", 15),
        ("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1", 19),
        ("/usr/lib/llvm-18/lib/libLLVM.so", 18),
        ("/opt/homebrew/opt/llvm@20/lib/libLLVM.dylib", 20),
        ("C:/Program Files/LLVM/bin/LLVM-C.dll", None),
    ],
)
def test_version_from_the_name(path: str, version: int | None) -> None:
    assert library_version(Path(path)) == version


def test_old_libraries_are_never_candidates() -> None:
    found = candidates()
    assert all(version is None or version >= MIN_VERSION for version, _ in found)
    assert require() >= (MIN_VERSION, 0, 0)


def test_missing_library_is_one_clear_error(tmp_path: Path) -> None:
    environment = os.environ | {"DRJIT_LIBLLVM_PATH": str(tmp_path / "libLLVM.so")}
    code = "from drjit_splat.llvm import require; require()"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "RuntimeError" in done.stderr
    assert "libllvm19" in done.stderr or sys.platform != "linux"
    assert "DRJIT_LIBLLVM_PATH" in done.stderr


def test_import_is_light() -> None:
    code = "import sys, drjit_splat; print(sorted({'torch', 'drjit', 'mitsuba'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.skipif(
    not Path("/proc/meminfo").exists(), reason="skipped: the system does not tell of its memory this way"
)
def test_memory_that_holds_files_counts_as_available() -> None:
    told = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
    available = available_memory()
    assert available is not None
    assert abs(available - 1024 * int(told["MemAvailable"].split()[0])) < 2**30
