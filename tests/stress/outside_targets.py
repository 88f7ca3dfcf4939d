"""Readers of what other programs make: FLAME files, HEIC, films, sound, skeletons, packets, light, questionnaires."""

from __future__ import annotations

import csv
import pickle
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import torch
from PIL import Image

from tests.flame_files import write_pickle
from tests.spoken import write_wav
from uika.data import DataError, open_capture
from uika.errors import UikaError
from uika.evaluate.study import COLUMNS, QUESTIONS, read_answers
from uika.head import HeadError
from uika.head_import import flame_file, from_flame
from uika.io.radiance_hdr import read_hdr
from uika.io.sound import read_sound
from uika.motion import Motion, MotionError, read_bvh, write_bvh
from uika.motion.live_link import FacePacket, read_packet, write_packet
from uika.photo import PhotoError
from uika.photo.read import read
from uika.tracking.decode import VideoError, decode, frame_rate

from . import mutate

_VERTICES, _SHAPES = 12, (4, 2)
Parts = tuple[Callable[[Path], list[Path]], mutate.Mutator, Callable[[Path], Any], type[Exception]]


def _small_flame() -> dict[str, np.ndarray]:
    """A model of a dozen vertices, and the reader told to expect no more: its sizes are constants of the module."""
    flame_file.VERTICES, (flame_file.IDENTITIES, flame_file.EXPRESSIONS) = _VERTICES, _SHAPES
    arrays = {
        "v_template": np.arange(3.0 * _VERTICES).reshape(-1, 3) / 100,
        "shapedirs": np.ones((_VERTICES, 3, sum(_SHAPES))),
        "posedirs": np.zeros((_VERTICES, 3, 36)),
        "J_regressor": np.eye(5, _VERTICES),
        "weights": np.ones((_VERTICES, 5), np.float32) / 5,
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]], np.uint32),
        "f": np.array([[0, 1, 2], [2, 3, 4]], np.uint32),
        "vt": np.random.default_rng(0).random((6, 2)),
        "ft": np.array([[0, 1, 2], [3, 4, 5]], np.uint32),
    }
    flame_file._SHAPES.update({name: arrays[name].shape for name in flame_file._SHAPES})
    return arrays


def _flame(folder: Path) -> list[Path]:
    arrays = _small_flame()
    np.savez(folder / "a.npz", **arrays)  # type: ignore[arg-type]
    tensors = {name: torch.from_numpy(np.asarray(array, np.float32)) for name, array in arrays.items()}
    torch.save(tensors, folder / "c.pt")
    torch.save(tensors, folder / "d.pt", _use_new_zipfile_serialization=False)
    made = [folder / "a.npz", folder / "c.pt", folder / "d.pt", write_pickle(folder / "b.pkl", arrays)]
    for protocol in (2, 4):
        made.append(folder / f"{protocol}.pkl")
        made[-1].write_bytes(pickle.dumps(arrays, protocol))
    return made


def _flame_damage(data: bytes, rng: random.Random) -> bytes:
    if data.startswith(b"PK"):
        return mutate.npz(data, rng)
    return mutate.pickled(data, rng) if data[2:3] in b"}\x95" else mutate.blind(data, rng)


def _obj(folder: Path) -> list[Path]:
    np.savez(folder / "model.npz", **_small_flame())  # type: ignore[arg-type]
    lines = [f"v {k} 0.5 1e-3" for k in range(_VERTICES)] + [f"vt 0.{k} 0.25" for k in range(6)]
    (folder / "a.obj").write_text("\n".join([*lines, "f 1/1 2/2 3/3 4/4", "f -1/1/1 5/-1/1 6/2/1", "s off"]))
    return [folder / "a.obj"]


def _read_obj(path: Path) -> None:
    flame_file.read_flame(path.parent.parent / "seeds" / "model.npz", path)


def _masks(folder: Path) -> list[Path]:
    lists = {name: np.arange(3) + k for k, name in enumerate(("face", "lips", "left_ear", "right_ear", "boundary"))}
    for protocol in (2, 4):
        (folder / f"{protocol}.pkl").write_bytes(pickle.dumps(lists | {"scalp": np.zeros(0, np.int64)}, protocol))
    return sorted(folder.iterdir())


def _heic(folder: Path) -> list[Path]:
    import pillow_heif

    smooth = Image.fromarray(np.random.default_rng(0).integers(0, 256, (9, 10, 3), np.uint8)).resize((80, 72))
    exif = Image.Exif()
    exif[0x0112] = 6
    pillow_heif.from_pillow(smooth).save(folder / "a.heic", exif=exif.tobytes())
    pillow_heif.from_pillow(smooth.convert("RGBA")).save(folder / "b.heic")
    deep = np.full((72, 80, 3), 512, np.uint16)
    pillow_heif.encode("RGB;10", (80, 72), deep.tobytes(), str(folder / "c.heic"))
    return sorted(folder.glob("*.heic"))


def _films(folder: Path) -> list[Path]:
    noise = np.random.default_rng(0).integers(0, 256, (4, 48, 64, 3), np.uint8)
    for name, codec, form in (("a.mp4", "libx264", "yuv420p"), ("b.webm", "libvpx-vp9", "yuv420p"),
                              ("c.avi", "mjpeg", "yuvj420p"), ("d.mkv", "libx264", "yuv420p"),
                              ("e.ts", "libx264", "yuv420p"), ("f.gif", "gif", "rgb8")):  # fmt: skip
        with av.open(str(folder / name), "w") as container:
            stream = container.add_stream(codec, rate=25)
            stream.height, stream.width, stream.pix_fmt = 48, 64, form
            for image in noise:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            container.mux(stream.encode(None))
    return sorted(folder.iterdir())


def _film_damage(data: bytes, rng: random.Random) -> bytes:
    return mutate.boxes(data, rng) if data[4:8] == b"ftyp" else mutate.blind(data, rng)


def _read_film(path: Path) -> None:
    for _ in decode(path, colour=True):
        pass
    frame_rate(path)


def _sounds(folder: Path) -> list[Path]:
    write_wav(folder / "a.wav", 0.5 * np.sin(np.arange(2000) / 9).astype(np.float32))
    for name, codec, kind in (
        ("b.flac", "flac", "s16"),
        ("c.m4a", "aac", "fltp"),
        ("d.ogg", "libopus", "flt"),
        ("e.mp3", "libmp3lame", "fltp"),
    ):
        with av.open(str(folder / name), "w") as container:
            stream = container.add_stream(codec, rate=48000)
            silence = np.zeros((1, 2880), np.int16 if kind == "s16" else np.float32)
            frame = av.AudioFrame.from_ndarray(silence, format=kind, layout="mono")
            frame.sample_rate = 48000
            container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
    return sorted(folder.iterdir())


def _skeletons(folder: Path) -> list[Path]:
    sizes = {"expression": 52, "rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3}
    write_bvh(Motion(fps=25.0, **{name: torch.full((3, size), 0.1) for name, size in sizes.items()}), folder / "a.bvh")
    (folder / "b.bvh").write_text(
        "HIERARCHY\nROOT Hips { OFFSET 0 0 0 CHANNELS 3 Zrotation Xrotation Yrotation\n"
        "JOINT mixamorig:Head { OFFSET 0 1 0 CHANNELS 1 Yrotation End Site { OFFSET 0 1 0 } }\n"
        "JOINT Arm { OFFSET 1 0 0 CHANNELS 1 Xrotation } }\n"
        "MOTION\nFrames: 2\nFrame Time: 0.04\n0 1 2 3 4\n5 6 7 8 9\n"
    )
    return sorted(folder.glob("*.bvh"))


def _packets(folder: Path) -> list[Path]:
    actions = np.linspace(0, 1, 52, dtype=np.float32)
    (folder / "a.bin").write_bytes(write_packet(FacePacket("phone", "anna", 3.5, actions, (0.1, 0.2, 0.3))))
    return [folder / "a.bin"]


def _read_packet(path: Path) -> None:
    try:
        read_packet(path.read_bytes()).motion()
    except MotionError as error:  # packets come from no file
        raise MotionError(f"{path}: {error}") from error


def _lights(folder: Path) -> list[Path]:
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 8\n"
    (folder / "a.hdr").write_bytes(head + bytes([1, 128, 3, 130] * 16))
    row = bytes([2, 2, 0, 8]) + b"".join(bytes([136, level]) for level in (9, 8, 7)) + bytes([8, *range(128, 136)])
    (folder / "b.hdr").write_bytes(head + row * 2)
    return [folder / "a.hdr", folder / "b.hdr"]


def _answers(folder: Path) -> list[Path]:
    (folder / "key.json").write_text('{"t1": {"clip": "anna", "method": "a"}, "t2": {"clip": "anna", "method": "b"}}')
    with (folder / "a.csv").open("w", newline="") as file:
        rows = [("p", "01", token, question, "3") for token in ("t1", "t2") for question in QUESTIONS]
        csv.writer(file).writerows([COLUMNS, *rows])
    return [folder / "a.csv"]


def _read_answers(path: Path) -> None:
    read_answers([path], path.parent.parent / "seeds" / "key.json")


def _canonical(folder: Path) -> list[Path]:
    from .targets import captures

    captures(folder)
    np.savez(
        folder / "a.npz.canonical.npz", shape=np.zeros(4), static_offset=np.zeros((1, 7, 3)), expr=np.zeros((1, 4))
    )
    return [folder / "a.npz.canonical.npz"]


def _read_canonical(path: Path) -> None:
    # Read where the other files lie, under the one name that it may have.
    place = path.parent.parent / "seeds" / "canonical_flame_param.npz"
    place.write_bytes(path.read_bytes())
    for _ in open_capture(place.parent, strict=True).samples(strict=True):
        pass


TARGETS: dict[str, Parts] = {
    "heic": (_heic, mutate.boxes, read, PhotoError),
    "flame": (_flame, _flame_damage, flame_file.read_flame, HeadError),
    "flame_obj": (_obj, mutate.text, _read_obj, HeadError),
    "flame_masks": (_masks, mutate.pickled, lambda path: from_flame._read_masks(path, _VERTICES), HeadError),
    "film": (_films, _film_damage, _read_film, VideoError),
    "sound": (_sounds, mutate.blind, read_sound, UikaError),
    "bvh": (_skeletons, mutate.text, read_bvh, MotionError),
    "live_link": (_packets, mutate.blind, _read_packet, MotionError),
    "hdr": (_lights, mutate.blind, read_hdr, UikaError),
    "study_answers": (_answers, mutate.text, _read_answers, UikaError),
    "canonical": (_canonical, mutate.npz, _read_canonical, DataError),
}
