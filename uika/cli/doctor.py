"""What this machine has of what the program needs."""

from __future__ import annotations

import importlib.util
import os
import platform
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

from uika._version import __version__
from uika.errors import EXTRAS, install_command

_CORE = ("torch", "drjit", "numpy", "safetensors")
_MODULES = {
    "ai-edge-litert": "ai_edge_litert",
    "drjit-splat": "drjit_splat",
    "opencv-python-headless": "cv2",
    "pillow": "PIL",
    "pillow-heif": "pillow_heif",
}  # distribution -> import name, where they differ
_DISTRIBUTIONS = {module: name for name, module in _MODULES.items()}


@dataclass(frozen=True)
class Finding:
    """One line of the examination; `remedy` is empty when all is well."""

    subject: str
    value: str
    remedy: str = ""
    needed: bool = True  # whether the program cannot do its work without it


def examine() -> list[Finding]:
    """Look at Python, the packages, LLVM, the threads and the head file; nothing is changed."""
    findings = [
        Finding("uika-drjit", __version__),
        Finding("python", f"{platform.python_version()} on {platform.system()} {platform.machine()}"),
    ]
    findings += [_package(module, 'pip install "uika-drjit"') for module in _CORE]
    findings.append(_package("drjit_splat", install_command("drjit_splat") or ""))
    findings += [
        _package(module, install_command(module) or "", EXTRAS[module] in ("cli", "photo")) for module in EXTRAS
    ]
    llvm = _llvm()
    return [*findings, llvm, _threads(with_llvm=not llvm.remedy), _head()]


def _package(module: str, remedy: str, needed: bool = True) -> Finding:
    name = _DISTRIBUTIONS.get(module, module)
    if importlib.util.find_spec(module) is None:
        return Finding(name, "missing", remedy, needed)
    try:
        return Finding(name, version(name), needed=needed)
    except PackageNotFoundError:
        return Finding(name, "version unknown", needed=needed)


def _llvm() -> Finding:
    try:
        from drjit_splat.llvm import ENV, require

        found = ".".join(str(part) for part in require())
    except (ImportError, RuntimeError) as error:
        return Finding("LLVM", "missing", str(error))
    return Finding("LLVM", f"{found} ({os.environ.get(ENV, 'found by Dr.Jit')})")


def _threads(with_llvm: bool) -> Finding:
    text = f"{os.cpu_count()} cores"
    if importlib.util.find_spec("torch") is not None:
        import torch

        text += f", torch {torch.get_num_threads()}"
    if with_llvm:
        import drjit

        text += f", Dr.Jit {drjit.thread_count()}"
    return Finding("threads", text)


def _head() -> Finding:
    try:
        from uika.head import load_head

        head = load_head()
    except (ImportError, ValueError) as error:
        return Finding("head model", "unusable", str(error))
    return Finding("head model", f"{head.id} ({len(head.template)} vertices, {len(head.expression_names)} expressions)")


@dataclass(frozen=True)
class Doctor:
    """Show versions, LLVM, threads and what is missing; exit 1 if something needed is.

    Example: uika doctor
    """

    def run(self) -> int:
        """Print the findings."""
        findings = examine()
        for finding in findings:
            print(f"{finding.subject:<12} {finding.value}")
            if finding.remedy and finding.value in ("missing", "unusable"):
                print(f"{'':<12} {'needed' if finding.needed else 'optional'}: {finding.remedy}")
        return int(any(finding.needed and finding.value in ("missing", "unusable") for finding in findings))
