"""Make sure that the tests of exported meshes find three.js and Khronos' validator: npm installs them into out/node.

Where npm is missing, apt installs it if this runs as root.
"""

import shutil
import subprocess
from pathlib import Path

from tools import apt_get

FOLDER = Path(__file__).resolve().parent.parent / "out" / "node"
PACKAGES = ("three@0.180.0", "@pixiv/three-vrm@3.5.5", "gltf-validator@2.0.0-dev.3.10")


def main() -> None:
    names = [package.rpartition("@")[0] for package in PACKAGES]
    if all((FOLDER / "node_modules" / name).is_dir() for name in names):
        print(f"node: {FOLDER}")
        return
    if shutil.which("npm") is None:
        apt_get.install(("npm",))
    if npm := shutil.which("npm"):
        FOLDER.mkdir(parents=True, exist_ok=True)
        subprocess.run([npm, "install", "--silent", "--prefix", str(FOLDER), *PACKAGES], check=False)
    missing = [name for name in names if not (FOLDER / "node_modules" / name).is_dir()]
    print(f"no {', '.join(missing)}: tests that need them are skipped; install npm" if missing else f"node: {FOLDER}")


if __name__ == "__main__":
    main()
