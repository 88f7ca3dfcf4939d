"""Damage to files: blind, or with the container's checksums put right so that it reaches the reader behind."""

from __future__ import annotations

import io
import json
import random
import re
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable

NUMBERS = (0, 1, 2, 127, 128, 255, 256, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1, 2**64 - 1)
WORDS = (
    *(b"0", b"-1", b"1e400", b"-1e400", b"NaN", b"Infinity", b"null", b"true", b"[]", b"{}", b'""', b'"\\u0000"'),
    *(b'"\\ud800"', b'"' + b"x" * 300 + b'"', b"9" * 30, b"9" * 400, b"9" * 5000, b"1e-400", b"4294967296", b"0.5"),
    *(b'"../../../etc/passwd"', b"[" * 2000, b'{"a":' * 2000, b'"/dev/zero"', b"-9223372036854775809"),
)

Mutator = Callable[[bytes, random.Random], bytes]


def _place(data: bytes, rng: random.Random) -> int:
    # Headers decide most, and they lie at the start.
    return rng.randrange(min(len(data), 128 if rng.random() < 0.5 else len(data)))


def blind(data: bytes, rng: random.Random) -> bytes:
    """One to four random edits that know nothing of the format."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        if not out:
            break
        at, kind = _place(bytes(out), rng), rng.randrange(8)
        length = rng.choice((1, 2, 4, 16, 64))
        if kind == 0:
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            out[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
        elif kind == 2:
            size, order = rng.choice((2, 4, 8)), rng.choice(("little", "big"))
            out[at : at + size] = (rng.choice(NUMBERS) % 256**size).to_bytes(size, order)  # type: ignore[arg-type]
        elif kind == 3:
            del out[at : at + length]
        elif kind == 4:
            out[at:at] = out[at : at + length] * rng.choice((1, 2, 100))
        elif kind == 5:
            out[at:at] = rng.randbytes(length)
        elif kind == 6:
            del out[at:]
        else:
            other = _place(bytes(out), rng)
            out[at : at + length] = out[other : other + length]
    return bytes(out)


_BOXES = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"meta", b"iprp", b"ipco", b"iinf", b"dinf", b"edts", b"udta")


def boxes(data: bytes, rng: random.Random) -> bytes:
    """Edit the content, the size or the name of one box of an MP4 or HEIC file, take it away, double or empty it."""
    if rng.random() < 0.3:
        return blind(data, rng)
    found: list[tuple[int, int]] = []
    waiting = [(0, len(data))]
    while waiting:
        at, end = waiting.pop()
        while at + 8 <= end:
            size, name = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
            if size < 8 or at + size > end:
                break
            found.append((at, at + size))
            if name in _BOXES:
                waiting.append((at + (12 if name in (b"meta", b"iinf") else 8), at + size))
            at += size
    if not found:
        return blind(data, rng)
    start, stop = rng.choice(found)
    box, kind = data[start:stop], rng.randrange(6)
    if kind < 2 and len(box) > 8:
        changed = blind(box[8:], rng)[: len(box) - 8].ljust(len(box) - 8, b"\0")
        box = box[:8] + changed
    elif kind == 2:
        box = (rng.choice(NUMBERS) % 2**32).to_bytes(4, "big") + box[4:]
    elif kind == 3:
        box = box[:4] + rng.choice((b"free", b"moov", b"mdat", b"\0\0\0\0", rng.randbytes(4))) + box[8:]
    elif kind == 4:
        box = rng.choice((b"", box * 2))
    else:
        box = (8).to_bytes(4, "big") + box[4:8]
    return data[:start] + box + data[stop:]


def text(data: bytes, rng: random.Random) -> bytes:
    """Replace a token of a text by an awkward one, or damage it blindly."""
    tokens = list(re.finditer(rb"[\w.+-]+|\"[^\"]*\"|[\[\]{},:]", data))
    if not tokens or rng.random() < 0.3:
        return blind(data, rng)
    token = rng.choice(tokens)
    new = rng.choice((*WORDS, rng.choice(tokens).group(), b""))
    return data[: token.start()] + new + data[token.end() :]


def ply(data: bytes, rng: random.Random) -> bytes:
    """Edit the header's words or the body."""
    end = data.find(b"end_header\n") + 11
    if rng.random() < 0.6:
        return text(data[:end], rng) + data[end:]
    return data[:end] + blind(data[end:], rng)


def png(data: bytes, rng: random.Random) -> bytes:
    """Edit one chunk of a PNG file and give it a right checksum."""
    if not data.startswith(b"\x89PNG") or rng.random() < 0.3:
        return blind(data, rng)
    chunks, at = [], 8
    while at + 12 <= len(data):
        (size,) = struct.unpack(">I", data[at : at + 4])
        chunks.append([data[at + 4 : at + 8], data[at + 8 : at + 8 + size]])
        at += 12 + size
    chosen = rng.choice(chunks)
    if chosen[0] == b"IDAT" and rng.random() < 0.5:
        chosen[1] = zlib.compress(blind(zlib.decompress(chosen[1]), rng))
    else:
        chosen[1] = blind(chosen[1], rng) if chosen[1] else rng.randbytes(8)
    if rng.random() < 0.1:
        rng.shuffle(chunks)
    body = (struct.pack(">I", len(c)) + k + c + struct.pack(">I", zlib.crc32(k + c)) for k, c in chunks)
    return data[:8] + b"".join(body)


def npz(data: bytes, rng: random.Random) -> bytes:
    """Edit a member of an archive, or claim another shape or type in its header; the archive itself stays right."""
    if rng.random() < 0.3:
        return blind(data, rng)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(list(members))
    kind = rng.randrange(4)
    if kind == 0:
        members[name] = blind(members[name], rng)
    elif kind == 1:
        members[name] = _npy_header(members[name], rng)
    elif kind == 2:
        members[rng.choice((*members, "x.npy", "expr.npy", "../../x.npy"))] = members.pop(name)
    else:
        members[name] = _npy(rng)
    out = io.BytesIO()
    packing = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
    with zipfile.ZipFile(out, "w", packing) as archive:
        for key, content in members.items():
            archive.writestr(key, content)
    return out.getvalue()


def _npy_header(data: bytes, rng: random.Random) -> bytes:
    """The same array with one word of its header replaced, and the header's length put right."""
    if data[:6] != b"\x93NUMPY" or len(data) < 12:
        return blind(data, rng)
    (size,) = struct.unpack("<H", data[8:10])
    header = data[10 : 10 + size]
    words = (b"'O'", b"'|V8'", b"'<U99999999'", b"'<c16'", b"'<M8[s]'", b"'|S0'", b"'>f8'", b"'<f4'", b"'|b1'")
    shapes = (b"()", b"(0,)", b"(-1,)", b"(4000000000,)", b"(99999,99999)", b"(1,1,1,1)", b"(0,4000000000)", b"(2,)")
    if rng.random() < 0.5:
        header = re.sub(rb"'descr': '[^']*'", b"'descr': " + rng.choice(words), header)
    else:
        header = re.sub(rb"'shape': \([^)]*\)", b"'shape': " + rng.choice(shapes), header)
    if rng.random() < 0.2:
        header = text(header, rng)
    return data[:8] + struct.pack("<H", len(header) % 65536) + header + data[10 + size :]


def _npy(rng: random.Random) -> bytes:
    """An array of a random awkward type, shape and content."""
    import numpy as np

    shape = rng.choice(((), (0,), (1,), (3,), (2, 3), (3, 1), (1, 52), (5, 6), (1, 3, 1)))
    kind = rng.choice(("f2", "f4", "f8", "g", "i1", "u8", "?", "c8", "U3", "S3", "m8[s]", ">f8"))
    array = np.zeros(shape, kind)
    if kind in ("f2", "f4", "f8", "g", ">f8"):
        array = array + np.array(rng.choice((np.nan, np.inf, 1e38, 1.0, -1.0)), "f8").astype(kind)
    out = io.BytesIO()
    np.save(out, array, allow_pickle=False)
    return out.getvalue()


def safetensors(data: bytes, rng: random.Random) -> bytes:
    """Edit the header as JSON, keeping its length right, or the tensors."""
    (size,) = struct.unpack("<Q", data[:8])
    header, body = data[8 : 8 + size], data[8 + size :]
    kind = rng.randrange(5)
    if kind == 0:
        return blind(data, rng)
    if kind == 1:
        return data[: 8 + size] + blind(body, rng)
    if kind == 2:
        entries = json.loads(header)
        name = rng.choice([key for key in entries if key != "__metadata__"])
        count = entries[name]["data_offsets"][1] - entries[name]["data_offsets"][0]
        width = rng.choice((1, 2, 4, 8))
        entries[name]["dtype"] = rng.choice(
            {1: ("U8", "BOOL"), 2: ("F16", "BF16"), 4: ("F32",), 8: ("F64", "I64")}[width]
        )
        shapes = [[count // width], [1, count // width], []] if count % width == 0 else [[count]]
        entries[name]["shape"] = rng.choice(shapes)
        header = json.dumps(entries).encode()
    elif kind == 3:
        entries = json.loads(header)
        key = rng.choice(list(entries["__metadata__"]))
        entries["__metadata__"][key] = rng.choice(WORDS).decode()
        header = json.dumps(entries).encode()
    else:
        header = text(header, rng)
    return struct.pack("<Q", len(header)) + header + body


def tar(data: bytes, rng: random.Random) -> bytes:
    """Edit a field of an entry's header and give it a right checksum, or edit a member's content."""
    kind = rng.randrange(4)
    if kind == 0:
        return blind(data, rng)
    with tarfile.open(fileobj=io.BytesIO(data)) as archive:
        members = archive.getmembers()
    member = rng.choice(members)
    start, end = member.offset_data, member.offset_data + member.size
    if kind == 1:
        inner = data[start:end]
        change = png if inner.startswith(b"\x89PNG") else npz if inner.startswith(b"PK") else text
        changed = change(inner, rng)
        changed = changed[: member.size].ljust(member.size, b" ")
        return data[:start] + changed + data[end:]
    block = bytearray(data[member.offset : member.offset + 512])
    field, size = rng.choice(((0, 100), (100, 8), (124, 12), (124, 12), (136, 12), (156, 1), (157, 100), (345, 155)))
    if kind == 2:
        block[field : field + size] = blind(bytes(block[field : field + size]), rng)[:size].ljust(size, b"\0")
    elif field == 156:
        block[156] = rng.choice(b"0123456789xgSLKDMNVX")
    else:
        value = rng.choice((b"77777777777\0", b"-0000000001\0", b"\x80" + b"\xff" * 11, b"\xff" * 12))
        block[124:136] = value
    block[148:156] = b" " * 8
    block[148:156] = b"%06o\0 " % sum(block)
    return data[: member.offset] + bytes(block) + data[member.offset + 512 :]


def pickled(data: bytes, rng: random.Random) -> bytes:
    """Insert, replace or remove instructions of a pickle, or damage it blindly."""
    import pickletools

    if rng.random() < 0.4:
        return blind(data, rng)
    places = [at for _, _, at in pickletools.genops(data) if at is not None]
    at = rng.choice(places)
    after = next((p for p in places if p > at), len(data))
    snippets = (
        *(
            b"(",
            b"0",
            b"1",
            b"2",
            b"]",
            b"}",
            b"t",
            b"R",
            b"b",
            b"s",
            b"u",
            b"a",
            b"e",
            b"\x81",
            b"\x85",
            b"N",
            b"K\xff",
        ),
        *(b"cos\nsystem\n", b"cbuiltins\neval\n", b"J\xff\xff\xff\x7f", b"\x8a\x08" + b"\xff" * 7 + b"\x7f", b"h\x00"),
        *(
            b"r\xff\xff\xff\x7f",
            b"G\x7f\xf0" + b"\0" * 6,
            b"X\x02\x00\x00\x00O8",
            b"Q",
            b"\x8f",
            b"\x90",
            b"\x93",
            b".",
        ),
    )
    return data[:at] + rng.choice((*snippets, data[at:after] * 2, b"")) + data[rng.choice((at, after)) :]
