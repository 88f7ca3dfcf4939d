"""Find a usable LLVM library for Dr.Jit before its LLVM backend starts."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

MIN_VERSION = 16  # 14 is refused by Dr.Jit, 15 aborts the process on vector minimum/maximum (llvm issue 53353)
ENV = "DRJIT_LIBLLVM_PATH"

_PATTERNS = {
    "linux": (
        "/usr/lib/*-linux-gnu/libLLVM*.so*",
        "/usr/lib/llvm-*/lib/libLLVM*.so*",
        "/usr/lib64/libLLVM*.so*",
        "/usr/lib64/llvm*/lib*/libLLVM*.so*",
        "/usr/lib/libLLVM*.so*",
        "/usr/local/lib/libLLVM*.so*",
        "/opt/llvm*/lib/libLLVM*.so*",
    ),
    "darwin": (
        "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
        "/usr/local/opt/llvm*/lib/libLLVM*.dylib",
        "/opt/local/libexec/llvm-*/lib/libLLVM*.dylib",
    ),
    "win32": (
        "C:/Program Files/LLVM*/bin/LLVM-C.dll",
        "C:/Program Files (x86)/LLVM*/bin/LLVM-C.dll",
    ),
}
_ENVIRONMENT_PATTERNS = ("lib/libLLVM*.so*", "lib/libLLVM*.dylib", "Library/bin/LLVM-C.dll", "Library/bin/libLLVM*.dll")


def library_version(path: Path) -> int | None:
    """Major version that a library's own name, its link target or an ``llvm-N`` folder states; None when none does."""
    for candidate in (path, path.resolve()):
        match = re.search(r"LLVM(?:-C)?[-.](?:so\.|dylib\.)?(\d+)", candidate.name)
        match = match or re.search(r"llvm[-@]?(\d+)(?=[/\\.])", candidate.as_posix(), re.IGNORECASE)
        if match:
            return int(match.group(1))
    return None


def candidates() -> list[tuple[int | None, Path]]:
    """LLVM libraries on this machine that may work, newest version first, those of unknown version last."""
    roots = [(Path(sys.prefix), pattern) for pattern in _ENVIRONMENT_PATTERNS]
    for pattern in _PATTERNS.get(sys.platform, ()):
        anchor = Path(Path(pattern).anchor)
        roots.append((anchor, Path(pattern).relative_to(anchor).as_posix()))
    found: dict[Path, int | None] = {}
    for root, pattern in roots:
        for path in root.glob(pattern):
            if path.is_file():
                found.setdefault(path.resolve(), library_version(path))
    usable = [(version, path) for path, version in found.items() if version is None or version >= MIN_VERSION]
    return sorted(usable, key=lambda item: (-(item[0] or 0), str(item[1])))


def _install_hint() -> str:
    package = {
        "linux": "`apt-get install libllvm19` (Fedora: `dnf install llvm-libs`; conda-forge: `libllvm19`)",
        "darwin": "`brew install llvm`",
        "win32": "`winget install LLVM.LLVM`",
    }.get(sys.platform, "LLVM 19 from your package manager")
    return f"install it with {package}, or set {ENV} to the full path of the library"


def select_library() -> None:
    """Point Dr.Jit at the newest LLVM >= 16 unless ``DRJIT_LIBLLVM_PATH`` already names a library.

    Call before anything uses ``drjit.llvm`` or a Mitsuba ``llvm_*`` variant: Dr.Jit reads the variable once.
    When nothing is found the variable stays unset and :func:`require` reports what to install.

    Raises:
        RuntimeError: ``DRJIT_LIBLLVM_PATH`` names a file that does not exist.
    """
    chosen = os.environ.get(ENV)
    if chosen:
        # A bare file name is looked up by the system's loader, so only a path can be checked here.
        if os.path.dirname(chosen) and not Path(chosen).is_file():  # noqa: PTH120 (keeps "./x" a path)
            raise RuntimeError(f"{ENV} is set to {chosen!r}, which does not exist; {_install_hint()}")
        return
    usable = candidates()
    if usable:
        os.environ[ENV] = str(usable[0][1])


def require() -> tuple[int, int, int]:
    """Start Dr.Jit's LLVM backend and return the version it runs on.

    Raises:
        RuntimeError: no LLVM >= 16 could be loaded; the message says what to install.
    """
    select_library()
    where = os.environ.get(ENV)
    stated = library_version(Path(where)) if where else None
    if stated is not None and stated < MIN_VERSION:  # Dr.Jit would complain in its own words first
        raise RuntimeError(f"{where} is LLVM {stated}, but {MIN_VERSION} or newer is needed; {_install_hint()}")
    import drjit as dr

    if not dr.has_backend(dr.JitBackend.LLVM):
        tried = f"the library {where!r} could not be loaded" if where else "no LLVM library was found"
        raise RuntimeError(
            f"Dr.Jit needs LLVM {MIN_VERSION} or newer to run on the CPU, but {tried}; {_install_hint()}"
        )
    major, minor, patch = dr.detail.llvm_version()
    if major < MIN_VERSION:
        raise RuntimeError(
            f"Dr.Jit started with LLVM {major}.{minor}, but {MIN_VERSION} or newer is needed; {_install_hint()}"
            " before Python starts"
        )
    return major, minor, patch
