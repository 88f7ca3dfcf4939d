"""Readers of splat files and of scenes' photos: small good files, and how to read them."""

from __future__ import annotations

import gzip
import io
import random
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from drjit_splat import load_ply, load_sog, load_spz, save_spz
from drjit_splat.training import open_capture
from tests.drjit_splat.test_compressed_ply import RECORDED as COMPRESSED
from tests.drjit_splat.test_spz import RECORDED, made_up
from tests.drjit_splat.training.made_up import write_colmap, write_nerfstudio

from . import mutate

TABLES = ("cameras", "images", "points3D")


def _spz(folder: Path) -> list[Path]:
    for version in (3, 4):
        shutil.copy(RECORDED / f"gsply_{version}.spz", folder)
    save_spz(folder / "own.spz", *vars(made_up(20, 1)).values())
    return sorted(folder.glob("*.spz"))


def _spz_damage(data: bytes, rng: random.Random) -> bytes:
    """Edit what the archive holds and pack it anew, or edit the archive."""
    if data[:2] == b"\x1f\x8b" and rng.random() < 0.7:
        return gzip.compress(mutate.blind(gzip.decompress(data), rng), 1)
    return mutate.blind(data, rng)


def _compressed(folder: Path) -> list[Path]:
    shutil.copy(COMPRESSED, folder / "a.ply")
    return [folder / "a.ply"]


def _sog(folder: Path) -> list[Path]:
    shutil.copy(RECORDED / "made_up.sog", folder / "a.sog")
    return [folder / "a.sog"]


def _sog_damage(data: bytes, rng: random.Random) -> bytes:
    """Edit one member and put the archive right, or edit the archive."""
    if rng.random() < 0.3:
        return mutate.blind(data, rng)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(["meta.json", "meta.json", *members])
    members[name] = (mutate.text if name == "meta.json" else mutate.blind)(members[name], rng)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for key, content in members.items():
            archive.writestr(key, content)
    return out.getvalue()


def _colmap(binary: bool) -> Callable[[Path], list[Path]]:
    def seeds(folder: Path) -> list[Path]:
        """Each table under its own ending, beside the data set that it belongs to."""
        write_colmap(folder / "scene", binary=binary)
        ending = "bin" if binary else "txt"
        for name in TABLES:
            shutil.copy(folder / "scene" / "sparse" / "0" / f"{name}.{ending}", folder / f"{ending}.{name}")
            shutil.copy(folder / f"{ending}.{name}", folder / "scene" / f"good.{name}")
        return [folder / f"{ending}.{name}" for name in TABLES]

    return seeds


def _read_colmap(path: Path) -> None:
    """Read the data set with this one table in the place of its own."""
    scene = path.parent.parent / "seeds" / "scene"
    tables = scene / "sparse" / "0"
    ending = next(tables.iterdir()).suffix
    for name in TABLES:
        chosen = path if path.suffix == f".{name}" else scene / f"good.{name}"
        shutil.copy(chosen, tables / f"{name}{ending}")
    open_capture(scene)


def _transforms(folder: Path) -> list[Path]:
    write_nerfstudio(folder / "scene", camera_model="PINHOLE", k1=0.0, ply_file_path="points.ply")
    text = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    (folder / "scene" / "points.ply").write_text(text + "0 0 0\n")
    shutil.copy(folder / "scene" / "transforms.json", folder / "a.json")
    return [folder / "a.json"]


def _read_transforms(path: Path) -> None:
    scene = path.parent.parent / "seeds" / "scene"
    shutil.copy(path, scene / "transforms.json")
    capture = open_capture(scene)
    for photo in (*capture.photos[:1], *capture.held_out[:1]):
        photo.pixels()


TARGETS: dict[str, tuple[Callable[[Path], list[Path]], mutate.Mutator, Callable[[Path], Any], type[Exception]]] = {
    "spz": (_spz, _spz_damage, load_spz, ValueError),
    "compressed_ply": (_compressed, mutate.ply, load_ply, ValueError),
    "sog": (_sog, _sog_damage, load_sog, ValueError),
    "colmap_text": (_colmap(binary=False), mutate.text, _read_colmap, ValueError),
    "colmap_binary": (_colmap(binary=True), mutate.blind, _read_colmap, ValueError),
    "scene_transforms": (_transforms, mutate.text, _read_transforms, ValueError),
}
