"""The tables of `.ply` files: what their first lines say, and rows of numbers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

HEADER_LIMIT = 1 << 16
_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}
_KINDS = ("binary_little_endian", "binary_big_endian", "ascii")


@dataclass(frozen=True)
class Element:
    """One kind of rows."""

    name: str
    count: int
    properties: tuple[tuple[str, str], ...]  # name and type as written; of a list, all that follows its name

    def layout(self, path: Path) -> np.dtype[np.void]:
        """The numpy type of a row.

        Raises:
            ValueError: a property is a list, of an unknown type or named twice; the message names the file.
        """
        for name, kind in self.properties:
            if kind not in _TYPES:
                raise ValueError(f"{path} has a property that cannot be read: {f'{kind} {name}'.strip()[:80]!r}")
        if len({name for name, _ in self.properties}) != len(self.properties):
            raise ValueError(f"{path} names a property twice")
        return np.dtype([(name, _TYPES[kind]) for name, kind in self.properties])


@dataclass(frozen=True)
class Header:
    """What the first lines say."""

    kind: str  # one of _KINDS
    length: int  # bytes before the first row
    elements: tuple[Element, ...]  # in the file's order; at least one


def read_header(path: Path) -> Header:
    """Read a file's first lines.

    Raises:
        ValueError: they are those of no `.ply` file that can be read; the message names it.
    """
    with path.open("rb") as file:
        start = file.read(HEADER_LIMIT)
    marker = start.find(b"end_header")
    end = start.find(b"\n", marker) + 1
    if not start.startswith(b"ply") or marker < 0 or end == 0:
        raise ValueError(f"{path} is not a .ply file (no header that starts with 'ply' and ends with 'end_header')")
    lines = [line.split() for line in start[:marker].decode("ascii", "replace").splitlines()]
    kind = next((line[1] for line in lines if line[:1] == ["format"] and line[2:] == ["1.0"]), "")
    if kind not in _KINDS:
        raise ValueError(f"{path} is of none of the formats {', '.join(_KINDS)}")
    elements: list[Element] = []
    for line in lines:
        if line[:1] == ["element"]:
            count = line[-1]
            if len(line) != 3 or not (count.isascii() and count.isdigit() and len(count) <= 18):
                raise ValueError(f"{path} has an element without a name and a count: {' '.join(line)[:80]!r}")
            elements.append(Element(line[1], int(count), ()))
        elif line[:1] == ["property"] and elements:
            last = elements.pop()
            entry = (line[2], line[1]) if len(line) == 3 else ("", " ".join(line[1:]))
            elements.append(Element(last.name, last.count, (*last.properties, entry)))
    if not elements:
        raise ValueError(f"{path} has no element")
    return Header(kind, end, tuple(elements))


def vertices(path: Path, header: Header) -> Element:
    """The element `vertex`, which must come first.

    Raises:
        ValueError: it does not.
    """
    if header.elements[0].name != "vertex":
        raise ValueError(f"{path} must start with one 'element vertex <count>'")
    return header.elements[0]


def read_rows(path: Path, header: Header, count: int) -> list[NDArray[np.void]]:
    """The rows of the first `count` elements.

    Raises:
        ValueError: the file is cut short or damaged, or a row cannot be read; the message names it.
    """
    chosen = header.elements[:count]
    layouts = [element.layout(path) for element in chosen]
    if header.kind == "ascii":
        return _read_text(path, header, layouts)
    sizes = [element.count * layout.itemsize for element, layout in zip(chosen, layouts, strict=True)]
    expected, size = header.length + sum(sizes), path.stat().st_size
    if size < expected:
        rows = ", ".join(f"{element.count} {element.name}" for element in chosen)
        raise ValueError(f"{path} is cut short: {rows} need {expected} bytes, the file has {size}")
    at, found = header.length, []
    for element, layout, length in zip(chosen, layouts, sizes, strict=True):
        stored = layout.newbyteorder(">") if header.kind == "binary_big_endian" else layout
        found.append(np.fromfile(path, stored, element.count, offset=at))
        at += length
    return found


def _read_text(path: Path, header: Header, layouts: list[np.dtype[np.void]]) -> list[NDArray[np.void]]:
    with path.open("rb") as file:
        file.seek(header.length)
        words = file.read().split()
    found: list[NDArray[np.void]] = []
    at = 0
    for element, layout in zip(header.elements, layouts, strict=False):
        needed = element.count * len(element.properties)
        if len(words) - at < needed:
            has = f"the file has {len(words) - at}"
            raise ValueError(f"{path} is cut short: {element.count} {element.name} need {needed} numbers, {has}")
        try:
            values = np.array(words[at : at + needed], dtype=np.float64).reshape(element.count, len(element.properties))
        except ValueError as error:
            raise ValueError(f"{path} has a word among its numbers ({error})") from None
        found.append(np.rec.fromarrays(list(values.T), dtype=layout))
        at += needed
    return found
