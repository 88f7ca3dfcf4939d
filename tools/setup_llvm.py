"""Make sure that Dr.Jit finds an LLVM library: look for one, else install it by apt where this runs as root."""

import os
import sys

from drjit_splat import llvm
from tools import apt_get

PACKAGES = ("libllvm19", "libllvm18", "libllvm17", "libllvm16")


def main() -> int:
    if not os.environ.get(llvm.ENV) and not llvm.candidates():
        apt_get.install(PACKAGES)
    try:
        major, minor, patch = llvm.require()
    except RuntimeError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"LLVM {major}.{minor}.{patch}: {os.environ.get(llvm.ENV, 'found by Dr.Jit')}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
