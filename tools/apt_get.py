"""Install a system package by apt, where there is apt and this runs as root."""

import os
import shutil
import subprocess
from collections.abc import Iterable


def install(packages: Iterable[str]) -> bool:
    """Install the first of `packages` that apt can install; False when it can none."""
    if shutil.which("apt-get") is None or os.geteuid() != 0:
        return False
    subprocess.run(["apt-get", "update", "-qq"], check=False)
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for package in packages:
        command = ["apt-get", "install", "-y", "-qq", "--no-install-recommends", package]
        done = subprocess.run(command, check=False, stdout=subprocess.DEVNULL, env=environment)
        if done.returncode == 0:
            print(f"installed {package}")
            return True
    return False
