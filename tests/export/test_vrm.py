"""VRM files load in three-vrm, and say what may be done with them."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.avatars import painted_avatar
from tests.chromium import page
from tests.served import served
from tools.setup_node import FOLDER
from uika import UikaError, load_head
from uika.export import write_vrm
from uika.head.actions import ARKIT_ACTIONS
from uika.io.glb import read_parts

MODULES = FOLDER / "node_modules"
DEMANDED = {"hips", "spine", "head"} | {
    f"{side}{part}"
    for side in ("left", "right")
    for part in ("UpperLeg", "LowerLeg", "Foot", "UpperArm", "LowerArm", "Hand")
}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    head = load_head()
    path = tmp_path_factory.mktemp("vrm") / "a.vrm"
    write_vrm(path, painted_avatar(head, 64), head, "me", size=64)
    return path


def test_bones_expressions_and_terms(written: Path) -> None:
    document, _ = read_parts(written)
    vrm = document["extensions"]["VRMC_vrm"]
    bones = {name: bone["node"] for name, bone in vrm["humanoid"]["humanBones"].items()}
    assert set(bones) >= DEMANDED and len(set(bones.values())) == len(bones)
    parent = {child: k for k, node in enumerate(document["nodes"]) for child in node.get("children", [])}
    chain = [bones["head"]]
    while chain[-1] in parent:
        chain.append(parent[chain[-1]])
    assert chain == [bones[name] for name in ("head", "neck", "spine", "hips")]
    assert set(vrm["expressions"]["custom"]) == set(ARKIT_ACTIONS)
    assert {"aa", "ih", "ou", "ee", "oh", "blink", "happy", "sad"} <= set(vrm["expressions"]["preset"])
    meta = vrm["meta"]
    assert meta["authors"] and meta["avatarPermission"] == "onlyAuthor" and meta["modification"] == "prohibited"
    assert "not stated" in meta["copyrightInformation"]


@pytest.mark.skipif(
    not (MODULES / "gltf-validator").is_dir() or not shutil.which("node"), reason="no gltf-validator: make node"
)
def test_khronos_validator_finds_no_fault(written: Path) -> None:
    script = (
        f"const v = require({str(MODULES / 'gltf-validator')!r}), fs = require('fs');"
        "v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1]))).then((r) => console.log(JSON.stringify(r)))"
    )
    done = subprocess.run(["node", "-e", script, str(written)], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)["issues"]
    assert found["numErrors"] == found["numWarnings"] == 0


@pytest.mark.skipif(not (MODULES / "@pixiv" / "three-vrm").is_dir(), reason="no three-vrm: make node")
def test_three_vrm_loads_and_moves_it(written: Path, tmp_path: Path) -> None:
    shutil.copy(written, tmp_path / "a.vrm")
    shutil.copy(Path(__file__).with_name("vrm.html"), tmp_path / "index.html")
    (tmp_path / "modules").symlink_to(MODULES)
    with served(tmp_path) as address, page(tmp_path) as tab:
        tab.open(f"{address}/index.html")
        tab.wait("!!window.found")
        found = tab.run("found")
        assert tab.problems == []
    assert found["meta"]["name"] == "me" and set(ARKIT_ACTIONS) <= set(found["expressions"])
    assert 1.3 < found["head"][1] < 1.7  # metres above the floor
    assert found["jaw"] == pytest.approx(0.6)
    before, after, head = (np.array(found[name]) for name in ("before", "after", "head"))
    away = before - head
    turned = np.array(
        [away[0] * np.cos(0.5) + away[2] * np.sin(0.5), away[1], away[2] * np.cos(0.5) - away[0] * np.sin(0.5)]
    )
    assert np.allclose(after - head, turned, atol=1e-3)


def test_a_wrong_name_is_refused(tmp_path: Path) -> None:
    head = load_head()
    with pytest.raises(UikaError, match=r"must end in \.vrm"):
        write_vrm(tmp_path / "a.glb", painted_avatar(head, 32), head)
