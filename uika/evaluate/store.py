"""The files of an evaluation: one for each sequence and number of views, complete or absent."""

from __future__ import annotations

import json
import math
import re
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from uika.errors import UikaError
from uika.evaluate.protocol import Protocol
from uika.evaluate.score import Scores
from uika.io.files import replacing

RESULTS, PICTURES, PROTOCOL, FRAMES = "results", "pictures", "protocol.json", "frames.json"


@dataclass(frozen=True)
class Result:
    """What one sequence scored with one number of views."""

    protocol: str  # digest
    sequence: str
    views: int
    driver: str  # sequence of the targets
    sources: tuple[str, ...]  # frames
    targets: tuple[str, ...]
    scores: Scores
    faces: int  # targets with a face in both pictures
    seconds: float  # to make the avatar; 0 for another system
    pictures: tuple[str, ...]  # files in the report's folder


def section_folder(report: Path, protocol: Protocol) -> Path:
    """Where the results of a protocol lie."""
    return report / RESULTS / f"{protocol.setting}-{protocol.task}" / plain_name(protocol.method)


def plain_name(text: str) -> str:
    """The text with only letters, digits, dots, dashes and underscores, usable as a file's name."""
    return re.sub(r"[^\w.-]+", "_", text).strip(".") or "_"


def agree(report: Path, protocol: Protocol) -> Path:
    """Write down the protocol of a new section, or make sure that it is that of the section in the folder.

    Returns:
        The section's folder.

    Raises:
        UikaError: the folder holds results of other choices, or its description is damaged.
    """
    folder = section_folder(report, protocol)
    file = folder / PROTOCOL
    if not file.exists():
        with replacing(file) as temporary:
            temporary.write_text(json.dumps(asdict(protocol), indent=1) + "\n")
        return folder
    found = read_protocol(file)
    if found != protocol:
        changed = [f.name for f in fields(Protocol) if getattr(found, f.name) != getattr(protocol, f.name)]
        raise UikaError(
            f"{file}: holds results made with another {', '.join(changed)}; choose another --name or folder"
        )
    return folder


def read_protocol(file: Path) -> Protocol:
    """Read the description of a section.

    Raises:
        UikaError: it is damaged.
    """
    try:
        return Protocol(**json.loads(file.read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise UikaError(f"{file}: cannot be read; remove its folder to start again ({error})") from error


def result_file(folder: Path, sequence: str, views: int) -> Path:
    """The file of one sequence and number of views."""
    return folder / f"{plain_name(sequence)}_{views:02d}.result.json"


def write_result(folder: Path, result: Result) -> None:
    """Write one result; its file appears whole or not at all."""
    with replacing(result_file(folder, result.sequence, result.views)) as temporary:
        temporary.write_text(json.dumps(asdict(result), indent=1) + "\n")


def read_result(file: Path, protocol: Protocol) -> Result | None:
    """Read a result; None when it is missing, torn, or not of this protocol, and so has to be made again."""
    try:
        content = json.loads(file.read_text())
        content = {f.name: content[f.name] for f in fields(Result)}
        for name in ("sources", "targets", "pictures"):
            content[name] = tuple(content[name])
        result = Result(**content)
        whole = result.protocol == protocol.digest() and _sound(result, protocol)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None
    return result if whole else None


def write_frames(folder: Path, frames: dict[str, Any]) -> None:
    """Write which frames are sources and targets, for other systems to render the same."""
    with replacing(folder / FRAMES) as temporary:
        temporary.write_text(json.dumps(frames, indent=1) + "\n")


def _sound(result: Result, protocol: Protocol) -> bool:
    if set(result.scores) != {metric.name for metric in protocol.metrics}:
        return False
    values = [value for each in result.scores.values() for value in each]
    lengths = {len(each) for each in result.scores.values()}
    return lengths == {len(result.targets)} and all(v is None or math.isfinite(v) for v in values)
