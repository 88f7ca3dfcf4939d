"""The shapes in which programs keep named activations in JSON."""

from __future__ import annotations

import json
import warnings
from typing import Any

from uika.errors import UikaWarning
from uika.motion.action_names import find_action
from uika.motion.motion import MotionError
from uika.motion.recording import Recording

_GROUPS = ("blendShapes", "blendshapes", "blend_shapes", "weights", "face_blendshapes", "faceBlendshapes", "categories")
_TIMES = {"time": 1.0, "timestamp": 1.0, "seconds": 1.0, "t": 1.0, "timestampMs": 1e-3, "timestamp_ms": 1e-3}
_RATES = ("fps", "frameRate", "exportFps", "frame_rate")
_NAMES = ("names", "facsNames", "blendshape_names")
_ROWS = ("frames", "weightMat")
_MEANING = "needs one pose {action: value}, a list of them, or names with one list of weights for each frame"


def parse(text: str) -> Recording:
    """A recording from JSON text, one value or one on each line.

    Raises:
        ValueError: no JSON.
        MotionError: JSON of another kind.
    """
    try:
        content = _loads(text)
    except json.JSONDecodeError:
        lines = [line for line in text.splitlines() if line.strip()]
        if len(lines) < 2:
            raise
        content = [_loads(line) for line in lines]
    names, frames, fps = _parts(content)
    if not isinstance(frames, list) or not frames:
        raise MotionError(_MEANING)
    rows = [_row(frame, names, index) for index, frame in enumerate(frames)]
    if not any(rows):
        raise MotionError("names no ARKit actions such as jawOpen")
    if any(isinstance(frame, dict) and frame.get("rotation") for frame in frames):
        warnings.warn("its head rotations, whose axes the format does not say, are not read", UikaWarning, stacklevel=2)
    return Recording(rows, [f"frame {index}" for index in range(len(rows))], _times(frames), fps)


def _loads(text: str) -> Any:
    return json.loads(text, object_pairs_hook=_once)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON, whose names must differ: programs disagree about which of two counts."""
    found = dict(pairs)
    if len(found) < len(pairs):
        twice = next(name for name, _ in pairs if sum(name == other for other, _ in pairs) > 1)
        raise MotionError(f"names '{twice[:40]}' twice in one place; keep one")
    return found


def _parts(content: Any) -> tuple[list[str] | None, Any, float | None]:
    """Names of the weights' columns, frames and frame rate."""
    if isinstance(content, list):
        # MediaPipe's result for one picture is itself a list, of categories.
        return None, [content] if content and _is_category(content[0]) else content, None
    if not isinstance(content, dict):
        raise MotionError(_MEANING)
    noted: Any = content.get("metadata")
    noted = noted if isinstance(noted, dict) else {}
    rate = next((place[key] for place in (content, noted) for key in _RATES if key in place), None)
    names = next((place[key] for place in (content, noted) for key in _NAMES if key in place), None)
    if names is not None and not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
        raise MotionError("its names are no list of words")
    if names is not None and len(set(names)) < len(names):
        raise MotionError(f"its names have '{max(names, key=names.count)[:40]}' twice; keep one")
    frames = next((content[key] for key in _ROWS if key in content), None)
    if frames is None:
        frames = _from_curves(content) or [content]
    try:
        return names, frames, None if rate is None else float(rate)
    except (ValueError, TypeError):
        raise MotionError(f"its frame rate is no number but '{str(rate)[:40]}'") from None


def _from_curves(content: dict[str, Any]) -> list[Any] | None:
    """Frames of a file that keeps one list of values for each action."""
    inner = next((content[key] for key in _GROUPS if isinstance(content.get(key), dict)), content)
    curves = {name: values for name, values in inner.items() if find_action(name) and isinstance(values, list)}
    if not curves:
        return None
    if len(lengths := {len(values) for values in curves.values()}) != 1:
        raise MotionError(f"its actions have lists of different lengths: {', '.join(map(str, sorted(lengths)[:5]))}")
    rest = {name: values for name, values in inner.items() if name not in curves and inner is not content}
    if rest:
        raise MotionError(f"'{next(iter(rest))}' is no ARKit action with a list of values")
    times = next((content[key] for key in _TIMES if isinstance(content.get(key), list)), None)
    frames: list[Any] = [dict(zip(curves, values, strict=True)) for values in zip(*curves.values(), strict=True)]
    if times is not None and len(times) == len(frames):
        return [{"time": time, "blendShapes": frame} for time, frame in zip(times, frames, strict=True)]
    return frames


def _row(frame: Any, names: list[str] | None, index: int) -> dict[str, Any] | None:
    """Name -> number of one frame; None where it has no face."""
    inner = frame
    for _ in range(3):  # categories lie in lists of faces, and those in results
        if isinstance(inner, dict):
            group = next((inner[key] for key in _GROUPS if key in inner), inner)
            if group is inner:
                break
            inner = group
        elif isinstance(inner, list) and len(inner) == 1 and not names and not _is_category(inner[0]):
            inner = inner[0]
    if inner is None or inner in ([], {}):
        return None
    if isinstance(inner, dict):
        return {str(name): value for name, value in inner.items()}
    if isinstance(inner, list) and all(_is_category(part) for part in inner):
        return {str(part.get("categoryName", part.get("category_name"))): part.get("score") for part in inner}
    if isinstance(inner, list) and names is not None:
        if len(inner) != len(names):
            raise MotionError(f"frame {index} has {len(inner)} weights for {len(names)} names")
        return dict(zip(names, inner, strict=True))
    raise MotionError(f"frame {index} holds numbers without names" if isinstance(inner, list) else _MEANING)


def _is_category(part: Any) -> bool:
    return isinstance(part, dict) and "score" in part and bool({"categoryName", "category_name"} & set(part))


def _times(frames: list[Any]) -> list[float] | None:
    for key, unit in _TIMES.items():
        if all(isinstance(frame, dict) and isinstance(frame.get(key), (int, float)) for frame in frames):
            return [float(frame[key]) * unit for frame in frames]
    return None
