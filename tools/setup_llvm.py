"""Make sure that Dr.Jit finds an LLVM library: look for one, else install it by apt where this runs as root."""

import os
import shutil
import subprocess
import sys

from drjit_splat import llvm

PACKAGES = ("libllvm19", "libllvm18", "libllvm17", "libllvm16")


def apt_install() -> bool:
    """Install the first package that apt knows; False when apt is absent or none could be installed."""
    if shutil.which("apt-get") is None or os.geteuid() != 0:
        return False
    subprocess.run(["apt-get", "update", "-qq"], check=False)
    for package in PACKAGES:
        command = ["apt-get", "install", "-y", "-qq", "--no-install-recommends", package]
        if subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode == 0:
            print(f"installed {package}")
            return True
    return False


def main() -> int:
    if not os.environ.get(llvm.ENV) and not llvm.candidates():
        apt_install()
    try:
        major, minor, patch = llvm.require()
    except RuntimeError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"LLVM {major}.{minor}.{patch}: {os.environ.get(llvm.ENV, 'found by Dr.Jit')}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
