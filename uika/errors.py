"""The base of the errors that tell a user what to change, and which extra brings a missing package."""

from __future__ import annotations

# Import name of each optional package -> the extra of this project that installs it.
EXTRAS = {
    "av": "cli",
    "c2pa": "sign",
    "openfacefx": "cli",
    "ai_edge_litert": "photo",
    "cv2": "view",
    "PIL": "cli",
    "tqdm": "cli",
    "tyro": "cli",
    "pillow_heif": "photo",
    "scipy": "photo",
    "mitsuba": "scenes",
    "OpenEXR": "scenes",
    "trimesh": "scenes",
    "tensorboard": "train",
    "viser": "view",
}


class UikaError(ValueError):
    """Input that cannot be used; the message is one sentence that names the argument or file and says what to do."""


class UikaWarning(UserWarning):
    """Input that is used although something about it is doubtful; the message is one sentence like an error's."""


def install_command(module: str) -> str | None:
    """The pip command that brings the package imported as `module`; None when no extra of this project does."""
    if module.partition(".")[0] == "drjit_splat":
        return "pip install drjit-splat, or in a checkout of this project: pip install ./drjit_splat"
    extra = EXTRAS.get(module.partition(".")[0])
    return None if extra is None else f'pip install "uika-drjit[{extra}]"'
