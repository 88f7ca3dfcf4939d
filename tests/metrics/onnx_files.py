"""ONNX files written by hand, so that no other package is needed."""

from pathlib import Path


def number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def block(field: int, content: bytes | str) -> bytes:
    data = content.encode() if isinstance(content, str) else content
    return _varint(field << 3 | 2) + _varint(len(data)) + data


def write_flatten(path: Path, side: int) -> Path:
    """A network that takes [1,3,side,side] and gives its values as one row."""

    def tensor(name: str, *shape: int) -> bytes:
        sizes = b"".join(block(1, number(1, size)) for size in shape)
        return block(1, name) + block(2, block(1, number(1, 1) + block(2, sizes)))

    node = block(1, "picture") + block(2, "row") + block(4, "Flatten")
    graph = block(1, node) + block(2, "flatten")
    graph += block(11, tensor("picture", 1, 3, side, side)) + block(12, tensor("row", 1, 3 * side * side))
    path.write_bytes(number(1, 8) + block(7, graph) + block(8, block(1, "") + number(2, 13)))
    return path


def _varint(value: int) -> bytes:
    parts = []
    while value > 127:
        parts.append(value & 127 | 128)
        value >>= 7
    return bytes([*parts, value])
