"""The tables as Markdown and HTML, with pictures."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from pathlib import Path
from urllib.parse import quote

from uika.evaluate.strips import titles
from uika.evaluate.tables import HEADINGS, Section, gather, heading, write_sequences
from uika.io.files import replacing

FILES = ("report.md", "report.html", "sequences.csv")
_PICTURES = 12  # at most, of each section
_TITLE = "Evaluation"
_EXPLAINED = (
    "Values are means over sequences of means over frames. ↑ more is better, ↓ less is better; the best of several "
    "methods with as many views is bold. “-”: not measurable, because no face was found."
)
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1180px; padding: 0 1rem; color: #1b1b1f; }
table { border-collapse: collapse; margin: 1rem 0; font-size: 13px; font-variant-numeric: tabular-nums; }
.wide { overflow-x: auto; }
th, td { padding: .3rem .45rem; text-align: right; border-bottom: 1px solid #d8d8de; vertical-align: bottom; }
th:first-child, td:first-child { text-align: left; }
td.absent { color: #8a8a94; font-size: 11px; }
details, .note { color: #4c4c55; }
.strips { display: grid; grid-template-columns: repeat(auto-fill, minmax(520px, 1fr)); gap: 1rem; }
figure { margin: 0; } figure img { width: 100%; display: block; border: 1px solid #d8d8de; }
.cells { display: flex; font-size: 12px; color: #4c4c55; } .cells span { flex: 1; text-align: center; }
figcaption { font-size: 13px; padding-top: .2rem; }
"""


def write_report(folder: Path) -> list[Path]:
    """Write `report.md`, `report.html` and `sequences.csv` from all results in a folder.

    Raises:
        UikaError: the description of a section is damaged.
    """
    sections = gather(folder)
    markdown, html, table = (folder / name for name in FILES)
    with replacing(markdown) as temporary:
        temporary.write_text("\n".join(_markdown(sections)) + "\n", encoding="utf-8")
    with replacing(html) as temporary:
        temporary.write_text("\n".join(_html(sections)) + "\n", encoding="utf-8")
    write_sequences(table, sections)
    return [markdown, html, table]


def markdown_table(section: Section) -> list[str]:
    """The table's lines."""
    names = [*HEADINGS, *map(heading, section.metrics)]
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    for row in section.rows:
        cells = []
        for metric in section.metrics:
            text = row.cell(metric)
            cells.append(f"**{text}**" if text == section.best(metric, row.views) else text)
        lines.append("| " + " | ".join([*(each.replace("|", r"\|") for each in row.counts), *cells]) + " |")
    return lines


def _protocols(section: Section) -> list[str]:
    """The choices behind the rows, each once."""
    return list(dict.fromkeys(line for row in section.rows for line in row.protocol.sentences()))


def _strips(section: Section) -> Iterator[tuple[str, str]]:
    """Path and caption of the pictures to show: one of each sequence before a second of any."""
    found = [
        (index, f"{result.sequence}, {row.protocol.method}, views: {row.views}, target {result.targets[index]}", path)
        for row in section.rows
        for result in row.results
        for index, path in enumerate(result.pictures)
    ]
    for _, caption, path in sorted(found, key=lambda each: each[0])[:_PICTURES]:
        yield path, caption


def _markdown(sections: list[Section]) -> Iterator[str]:
    yield f"# {_TITLE}\n\n{_EXPLAINED}\n"
    for section in sections:
        yield f"## {section.title}\n"
        yield from markdown_table(section)
        yield "\nProtocol:\n"
        yield from (f"- {line}" for line in _protocols(section))
        yield f"\nPictures: {' | '.join(titles(section.task))}\n"
        yield from (f"![{caption}]({quote(path)})" for path, caption in _strips(section))
        yield ""


def _html(sections: list[Section]) -> Iterator[str]:
    yield '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
    yield '<meta name="viewport" content="width=device-width, initial-scale=1">'
    yield f"<title>{_TITLE}</title><style>{_STYLE}</style></head><body>"
    yield f'<h1>{_TITLE}</h1><p class="note">{_EXPLAINED}</p>'
    for section in sections:
        yield f'<h2>{escape(section.title)}</h2><div class="wide"><table><thead><tr>'
        yield "".join(f"<th>{escape(name)}</th>" for name in [*HEADINGS, *map(heading, section.metrics)])
        yield "</tr></thead><tbody>"
        for row in section.rows:
            yield "<tr>" + "".join(f"<td>{escape(text)}</td>" for text in row.counts)
            for metric in section.metrics:
                text, kind = row.cell(metric), "" if row.value(metric) is not None else ' class="absent"'
                shown = f"<b>{escape(text)}</b>" if text == section.best(metric, row.views) else escape(text)
                yield f"<td{kind}>{shown}</td>"
            yield "</tr>"
        yield '</tbody></table></div><details open><summary>Protocol</summary><ul class="note">'
        yield from (f"<li>{escape(line)}</li>" for line in _protocols(section))
        yield '</ul></details><div class="strips">'
        cells = "".join(f"<span>{title}</span>" for title in titles(section.task))
        for path, caption in _strips(section):
            image = f'<img src="{escape(quote(path))}" alt="{escape(caption)}" loading="lazy">'
            yield f'<figure><div class="cells">{cells}</div>{image}<figcaption>{escape(caption)}</figcaption></figure>'
        yield "</div>"
    yield "</body></html>"
