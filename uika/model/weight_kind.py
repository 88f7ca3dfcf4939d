"""Which kind of weights a file holds, from its header alone, so that no file is taken for another."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from safetensors import SafetensorError, safe_open

from uika.model.checkpoint import FORMAT, CheckpointError

Kind = Literal["model", "released model", "estimator", "released estimator", "backbone", "LPIPS", "avatar", "unknown"]

ESTIMATOR_FORMAT = "uika-estimator"
_FORMATS: dict[str, Kind] = {FORMAT: "model", ESTIMATOR_FORMAT: "estimator", "uika-avatar": "avatar"}
# What is said of a file in the place of another, and which option takes it.
_WORDS: dict[Kind, tuple[str, str]] = {
    "model": ("a reconstruction model", "--model"),
    "released model": ("the released reconstruction model", "--model"),
    "estimator": ("a correspondence estimator", "--estimator"),
    "released estimator": ("the released correspondence estimator", "--estimator"),
    "backbone": ("a DINOv3 backbone", "--backbone"),
    "LPIPS": ("LPIPS weights", "--lpips"),
    "avatar": ("an avatar", ""),
    "unknown": ("weights of another kind", ""),
}
MODELS: tuple[Kind, ...] = ("model", "released model")
# A released model brings its own estimator.
ESTIMATORS: tuple[Kind, ...] = ("estimator", "released estimator", "released model")


def weight_kind(path: str | Path) -> Kind:
    """What a safetensors file holds.

    Raises:
        CheckpointError: it is missing, or no safetensors file.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"{path}: no such weight file")
    try:
        with safe_open(path, framework="pt") as file:
            header, names = file.metadata() or {}, list(file.keys())
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path}: damaged, truncated or no safetensors file ({error})") from error
    if kind := _FORMATS.get(header.get("format", "")):
        return kind
    starts = {name.split(".")[0] for name in names}
    if {"transformer", "gs_decoder"} <= starts:
        return "released model"
    if "fuvt" in starts:
        return "released estimator"
    if any(name.endswith(("patch_embed.proj.weight", "patch_embeddings.weight")) for name in names):
        return "backbone"
    return "LPIPS" if {"features", "lin0"} <= starts else "unknown"


def check_kind(path: str | Path, wanted: tuple[Kind, ...]) -> Kind:
    """The kind of a file, if it is one of those wanted.

    Raises:
        CheckpointError: it is another one; the sentence says which, and which option takes it.
    """
    kind = weight_kind(path)
    if kind in wanted:
        return kind
    found, option = _WORDS[kind]
    remedy = f"; give it with {option}" if option else ""
    raise CheckpointError(f"{path}: is {found}, not {_WORDS[wanted[0]][0]}{remedy}")
