import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, **environment},
        timeout=120,
        check=False,
    )


def test_importing_scenes_loads_no_renderer() -> None:
    result = run("import sys, scenes; print([m for m in ('mitsuba', 'drjit', 'OpenEXR') if m in sys.modules])")
    assert result.stdout.strip() == "[]", result.stderr


def test_without_llvm_colour_is_rendered_and_the_rest_explained(tmp_path: Path) -> None:
    fake = tmp_path / "libLLVM.so"
    fake.write_bytes(b"")
    code = """
import scenes, warnings
from tests.heads import sphere_head
from uika.head import look_at
head = sphere_head()
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    image = scenes.render(head.template, head, look_at(distance=0.8, size=16), aovs=("rgb", "mask"), spp=2)
print(scenes.load_mitsuba().variant(), image["mask"].max(), sum("LLVM" in str(w.message) for w in caught))
try:
    scenes.render(head.template, head, look_at(size=16), aovs=("depth",))
except RuntimeError as error:
    print(error)
"""
    result = run(code, DRJIT_LIBLLVM_PATH=str(fake))
    assert result.returncode == 0, result.stderr
    assert "scalar_rgb 1.0 1" in result.stdout
    assert "install LLVM" in result.stdout
