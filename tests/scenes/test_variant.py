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


def test_the_callers_variant_is_kept_and_its_scene_still_renders() -> None:
    code = """
import mitsuba as mi
mi.set_variant("scalar_rgb")
mine = mi.load_dict(mi.cornell_box() | {"sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8,
                                                                                    "height": 8}}})
import drjit as dr, numpy as np
import scenes
from scenes.head_scene import load_head_scene
from scenes.synthesis.deferred import Shader, as_texture
from scenes.synthesis.vertex_light import gather_light, lit_scene
from scenes.variant import step_by_step
from tests.heads import sphere_head
from uika.head import look_at, vertex_normals
head, camera = sphere_head(), look_at(distance=0.8, size=16)
first, threads, seen = np.array(mi.render(mine, spp=1)), dr.thread_count(), []
scenes.render(head.template, head, camera, spp=1); seen.append(mi.variant())
scenes.register_plugins(); seen.append(mi.variant())
scene = lit_scene(head, "studio"); seen.append(mi.variant())
scene.pose(head, head.template); seen.append(mi.variant())
gather_light(scene, head.template, vertex_normals(head.template, head.faces), 4, 0); seen.append(mi.variant())
as_texture(np.full((4, 4, 3), 0.5), np.full((4, 4), 0.5)); seen.append(mi.variant())
seen += [mi.variant() for inside in step_by_step(mi.variant() for _ in range(2)) if inside == "llvm_ad_rgb"]
print(seen == 8 * ["scalar_rgb"], threads == dr.thread_count(), np.array_equal(first, np.array(mi.render(mine, spp=1))))
"""
    result = run(code)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "True True True", result.stdout
