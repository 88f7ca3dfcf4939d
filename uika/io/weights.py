"""Pretrained weights: what each file is for, its licence, where it must lie, and whether what lies there is whole.

Nothing is ever fetched: the files are other people's, and their licences are for the user to accept.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

FOLDER_VARIABLE = "UIKA_WEIGHTS"
_BLOCK = 1 << 22


@dataclass(frozen=True)
class WeightFile:
    """A file the program can use.

    `sha256` may be shortened to the first and last digits that its publisher shows, as "first...last"; empty if none.
    """

    name: str
    purpose: str
    command: str  # that it unlocks
    licence: str
    source: str
    sha256: str
    gigabytes: float


@dataclass(frozen=True)
class WeightStatus:
    """A file and what was found: "missing", "verified", "unverified" (no published digest) or "damaged"."""

    file: WeightFile
    path: Path
    state: str


FILES = (
    WeightFile(
        name="uika.safetensors",
        purpose="the authors' trained network with its estimator and backbone; needs FLAME 2023 (with jaw) as head",
        command="uika reconstruct photo.jpg --model uika.safetensors --head flame.npz -o me.safetensors "
        "(and uika evaluate --model)",
        licence="MIT; holds FLAME-derived tables under the FLAME licence and DINOv3 weights under the DINOv3 licence",
        source="https://huggingface.co/Yuukki/UIKA",
        sha256="a1d7f56e...eb46a",
        gigabytes=4.9,
    ),
    WeightFile(
        name="fuvt_15k.safetensors",
        purpose="the authors' facial correspondence estimator alone, for a FLAME head",
        command="--estimator fuvt_15k.safetensors of uika reconstruct, track, evaluate and train",
        licence="MIT; holds DINOv3 weights under the DINOv3 licence",
        source="https://huggingface.co/Yuukki/UIKA",
        sha256="93163025...4e2a",
        gigabytes=1.4,
    ),
    WeightFile(
        name="dinov3_vitl16_pretrain_lvd1689m.safetensors",
        purpose="DINOv3 ViT-L/16, the frozen backbone for training at the paper's size",
        command="uika train --preset paper --backbone FILE, and uika reconstruct --backbone for weights without one",
        licence="DINOv3 licence (to be accepted at the source)",
        source="https://huggingface.co/facebook/dinov3-vitl16-pretrain-lvd1689m (model.safetensors, renamed)",
        sha256="",
        gigabytes=1.2,
    ),
    WeightFile(
        name="dinov3_vits16_pretrain_lvd1689m.safetensors",
        purpose="DINOv3 ViT-S/16, the frozen backbone for training at the middle size, of both networks",
        command="uika train --preset base --backbone FILE",
        licence="DINOv3 licence (to be accepted at the source)",
        source="https://huggingface.co/facebook/dinov3-vits16-pretrain-lvd1689m (model.safetensors, renamed)",
        sha256="",
        gigabytes=0.09,
    ),
    WeightFile(
        name="dinov3_vitb16_pretrain_lvd1689m.safetensors",
        purpose="DINOv3 ViT-B/16, the backbone of the estimator for training at the paper's size",
        command="uika train --preset paper --part estimator --backbone FILE",
        licence="DINOv3 licence (to be accepted at the source)",
        source="https://huggingface.co/facebook/dinov3-vitb16-pretrain-lvd1689m (model.safetensors, renamed)",
        sha256="",
        gigabytes=0.35,
    ),
)


def folder() -> Path:
    """Where weight files lie: the folder named by UIKA_WEIGHTS, else ~/.local/share/uika/weights."""
    named = os.environ.get(FOLDER_VARIABLE, "")
    return Path(named) if named else Path.home() / ".local" / "share" / "uika" / "weights"


def check_weights(where: Path | None = None, verify: bool = True) -> list[WeightStatus]:
    """Look for every file in `where` (None: `folder()`) and compare digests, which reads the files whole.

    `verify` False only looks; a file that is there then counts as "unverified".
    """
    place = folder() if where is None else where
    return [WeightStatus(file, place / file.name, _state(place / file.name, file, verify)) for file in FILES]


def matches(digest: str, published: str) -> bool:
    """Whether a full hexadecimal digest agrees with a published one, which may be shortened to "first...last"."""
    first, dots, last = published.partition("...")
    return digest.startswith(first) and digest.endswith(last) if dots else digest == published


def sha256(path: Path) -> str:
    """Hexadecimal digest of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def _state(path: Path, file: WeightFile, verify: bool) -> str:
    if not path.is_file():
        return "missing"
    if not verify or not file.sha256:
        return "unverified"
    return "verified" if matches(sha256(path), file.sha256) else "damaged"
