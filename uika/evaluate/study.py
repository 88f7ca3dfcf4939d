"""A user study as in the paper's supplement: a blinded questionnaire that works offline, and its table."""

from __future__ import annotations

import base64
import csv
import hashlib
import html
import json
import math
import random
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from uika.errors import UikaError
from uika.io.files import check_folder, replacing

PAGE, KEY, TABLE = "study.html", "study_key.json", "study_table.md"
QUESTIONS = ("Render quality", "Motion consistency", "Identity preservation")
LEAST, MOST = 1, 5
_SCORES = [str(score) for score in range(LEAST, MOST + 1)]
REFERENCE = "reference"  # the folder of what is shown beside the clips and not rated
COLUMNS = ("participant", "clip", "shown", "question", "score")
_KINDS = {".mp4": "video/mp4", ".webm": "video/webm", ".png": "image/png", ".jpg": "image/jpeg", ".gif": "image/gif"}
_LARGEST = 256 << 20  # bytes of all clips of a page, which browsers still open
_TEMPLATE = Path(__file__).parent / "study_page.html"


@dataclass(frozen=True)
class Rating:
    """What the participants gave one method for one question."""

    method: str
    question: str
    count: int
    mean: float
    error: float  # half width of the 95 % interval of the mean


def write_study(clips: str | Path, output: str | Path, seed: int = 0) -> tuple[Path, Path]:
    """Write a questionnaire and, for those who hold the study, the key to it.

    Args:
        clips: a folder with one folder for each method, with clips of the same names (.mp4, .webm, .gif, .png, .jpg);
            a folder `reference` holds what is shown beside them.
        output: the study's folder.
        seed: of the names under which clips are shown.

    Returns:
        The page and the key; the page does not tell which method made a clip.

    Raises:
        UikaError: there are fewer than two methods, a clip is missing from one, or all are too large for a page.
    """
    folder, target = Path(clips), check_folder(output)
    methods = _methods(folder)
    names = sorted(methods[next(iter(methods))])
    for method, files in methods.items():
        if missing := sorted(set(names) ^ set(files)):
            raise UikaError(f"{folder / method}: has other clips than the first method, such as '{missing[0]}'")
    references = _clips(folder / REFERENCE) if (folder / REFERENCE).is_dir() else {}
    sizes = [clip.stat().st_size for found in [*methods.values(), references] for clip in found.values()]
    if (size := sum(sizes)) > _LARGEST:
        raise UikaError(f"{folder}: holds {size >> 20} MiB of clips; a page takes {_LARGEST >> 20}, make them smaller")
    key: dict[str, dict[str, str]] = {}
    shown = []
    for number, name in enumerate(names):
        tokens = {_token(seed, name, method): method for method in methods}
        media = [{"token": token, "source": _embedded(methods[tokens[token]][name])} for token in sorted(tokens)]
        reference = _embedded(references[name]) if name in references else ""
        shown.append({"clip": f"{number + 1:02d}", "media": media, "reference": reference})
        key |= {token: {"clip": name, "method": method} for token, method in tokens.items()}
    data = {"clips": shown, "questions": QUESTIONS, "least": LEAST, "most": MOST, "columns": COLUMNS}
    # Text inside a script element must not end it.
    text = _TEMPLATE.read_text(encoding="utf-8").replace("{{DATA}}", json.dumps(data).replace("</", "<\\/"))
    page, secret = target / PAGE, target / KEY
    with replacing(page) as temporary:
        temporary.write_text(text, encoding="utf-8")
    with replacing(secret) as temporary:
        temporary.write_text(json.dumps(key, indent=1) + "\n", encoding="utf-8")
    return page, secret


def read_answers(answers: Sequence[str | Path], key: str | Path) -> list[Rating]:
    """Mean ratings of every method and question from filled questionnaires.

    Raises:
        UikaError: a file cannot be read, holds something else, or a score out of range; the message names it.
    """
    try:
        names = json.loads(Path(key).read_text(encoding="utf-8"))
        known = {str(token): str(entry["method"]) for token, entry in names.items()}
    except (OSError, ValueError, AttributeError, KeyError, TypeError) as error:
        raise UikaError(f"{key}: cannot be read as the key of a study; `uika study` writes it") from error
    scores: dict[tuple[str, str], list[int]] = defaultdict(list)
    seen: set[tuple[str, ...]] = set()
    for path in map(Path, answers):
        for line, row in enumerate(_rows(path), 2):
            where = f"{path}: line {line}"
            if row["shown"] not in known or row["question"] not in QUESTIONS:
                raise UikaError(f"{where} is of another study; give the key of its own")
            if row["score"] not in _SCORES:
                raise UikaError(f"{where}: the score must be {LEAST} to {MOST}, not '{row['score'][:20]}'")
            place = (row["participant"], row["shown"], row["question"])
            if place in seen:
                raise UikaError(f"{where}: participant '{row['participant']}' answered before; give each file once")
            seen.add(place)
            scores[known[row["shown"]], row["question"]].append(int(row["score"]))
    methods = sorted(set(known.values()))
    return [_rating(method, question, scores[method, question]) for method in methods for question in QUESTIONS]


def write_table(ratings: Sequence[Rating], output: str | Path) -> Path:
    """Write the study's table as Markdown: a row for each question, the best method of each bold."""
    target = check_folder(output) / TABLE
    methods = list(dict.fromkeys(rating.method for rating in ratings))
    place = {(rating.method, rating.question): rating for rating in ratings}
    lines = [f"| | {' | '.join(methods)} |", "|" + "---|" * (1 + len(methods))]
    for question in QUESTIONS:
        row = [place[method, question] for method in methods]
        best = max((rating.mean for rating in row if rating.count), default=math.nan)
        cells = [_cell(rating, best) for rating in row]
        lines.append(f"| {question} ↑ | {' | '.join(cells)} |")
    with replacing(target) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return target


def _methods(folder: Path) -> dict[str, dict[str, Path]]:
    found = {each.name: _clips(each) for each in sorted(folder.glob("*")) if each.is_dir() and each.name != REFERENCE}
    methods = {name: clips for name, clips in found.items() if clips}
    if len(methods) < 2:
        raise UikaError(f"{folder}: needs two or more folders, one for each method, with clips ({', '.join(_KINDS)})")
    return methods


def _clips(folder: Path) -> dict[str, Path]:
    return {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.lower() in _KINDS}


def _token(seed: int, clip: str, method: str) -> str:
    """A name that says nothing about the method to those who do not know all three."""
    salt = random.Random(f"{seed} {clip}").random()
    return hashlib.sha256(f"{seed} {salt} {clip} {method}".encode()).hexdigest()[:16]


def _embedded(path: Path) -> str:
    return f"data:{_KINDS[path.suffix.lower()]};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _rows(path: Path) -> list[dict[str, str]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            if tuple(reader.fieldnames or ()) != COLUMNS:
                raise UikaError(f"{path}: is no filled questionnaire; its first line must be {','.join(COLUMNS)}")
            return [{name: (row[name] or "").strip() for name in COLUMNS} for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UikaError(f"{path}: cannot be read as .csv ({error})") from error


def _rating(method: str, question: str, scores: list[int]) -> Rating:
    count = len(scores)
    mean = sum(scores) / count if count else math.nan
    spread = sum((score - mean) ** 2 for score in scores) / (count - 1) if count > 1 else math.nan
    return Rating(method, question, count, mean, 1.96 * math.sqrt(spread / count) if count > 1 else math.nan)


def _cell(rating: Rating, best: float) -> str:
    if not rating.count:
        return "-"
    text = f"{rating.mean:.2f}" + (f" ± {rating.error:.2f}" if rating.count > 1 else "")
    shown = f"**{text}**" if rating.mean == best else text
    return f"{html.escape(shown)} ({rating.count})"
