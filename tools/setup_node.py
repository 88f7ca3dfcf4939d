"""Make sure that the tests of exported meshes find three.js and Khronos' validator: npm installs them into out/node."""

import shutil
import subprocess
from pathlib import Path

FOLDER = Path(__file__).resolve().parent.parent / "out" / "node"
PACKAGES = ("three@0.180.0", "gltf-validator@2.0.0-dev.3.10")


def main() -> None:
    names = [package.partition("@")[0] for package in PACKAGES]
    npm = shutil.which("npm")
    if npm and not all((FOLDER / "node_modules" / name).is_dir() for name in names):
        FOLDER.mkdir(parents=True, exist_ok=True)
        subprocess.run([npm, "install", "--silent", "--prefix", str(FOLDER), *PACKAGES], check=False)
    missing = [name for name in names if not (FOLDER / "node_modules" / name).is_dir()]
    print(f"no {', '.join(missing)}: tests that need them are skipped; install npm" if missing else f"node: {FOLDER}")


if __name__ == "__main__":
    main()
