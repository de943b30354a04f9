"""Damage within formats that have lengths and checksums, which are right again afterwards."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import pickletools
import re
import struct
import tarfile
import zipfile
from itertools import pairwise
from random import Random
from typing import Any

import numpy as np

from fuzzing.mutations import damaged_bytes, damaged_json, damaged_text

_TYPES = (
    "<f4",
    "<f8",
    "<f2",
    ">f8",
    "<i8",
    "<u1",
    "|b1",
    "<c16",
    "|O",
    "<U5",
    "|S3",
    "<M8[s]",
    "[('a', '<f4')]",
    "|V8",
    "<U1000000",
    "<f16",
)


def damaged_npy(random: Random, data: bytes, other: bytes) -> bytes:
    """An .npy with another shape, type, order or version, or with numbers that are none; its header's length
    is right.
    """
    if random.random() < 0.15 or data[:6] != b"\x93NUMPY":
        return damaged_bytes(random, data, other)
    wide = data[6] > 1
    length = int.from_bytes(data[8 : 12 if wide else 10], "little")
    begin = 12 if wide else 10
    header = data[begin : begin + length].decode("latin1")
    body = bytearray(data[begin + length :])
    match random.randrange(6):
        case 0:
            shape = re.search(r"'shape': \(([^)]*)\)", header)
            sizes = [int(size) for size in re.findall(r"\d+", shape[1] if shape else "")] or [1]
            at = random.randrange(len(sizes))
            sizes[at] = random.choice((0, 1, sizes[at] + 1, sizes[at] * 2, -1, 2**31, 2**62, 10**12))
            if random.random() < 0.2:
                sizes.insert(at, random.choice((1, 0, 2)))
            inside = ", ".join(map(str, sizes)) + ","
            header = re.sub(r"\([^)]*\)", f"({inside})", header, count=1)
            kind = re.search(r"'descr': '[<>|]?([a-zA-Z])(\d+)'", header)
            total = int(np.prod([abs(size) for size in sizes], dtype=object)) * int(kind[2] if kind else 1)
            if random.random() < 0.5 and 0 <= total < 2_000_000:  # as many bytes as it says
                body = (body + body * (total // max(1, len(body)) + 1))[:total] if body else bytearray(total)
        case 1:
            kind = random.choice(_TYPES)
            header = re.sub(
                r"'descr': ('[^']*'|\[[^\]]*\])", f"'descr': {kind if kind[0] == '[' else repr(kind)}", header
            )
        case 2:
            header = random.choice(
                (
                    header.replace("False", "True"),
                    header[:-2],
                    damaged_text(random, header.encode("latin1"), b"").decode("latin1", "replace"),
                )
            )
        case 3 | 4 if body:
            kind = re.search(r"'descr': '([<>|]f[248])'", header)
            values = (
                np.frombuffer(bytes(body), kind[1]).copy()
                if kind and not len(body) % int(kind[1][2])
                else None
            )
            if values is not None and len(values):
                some = [random.randrange(len(values)) for _ in range(random.choice((1, 3, 50)))]
                with np.errstate(all="ignore"):
                    values[some] = random.choice(
                        (np.nan, np.inf, -np.inf, 1e300, 1e30, 1e6, -1e4, 0, 1e-300, 3.0)
                    )
                if random.random() < 0.1:
                    values[:] = random.choice((0, 1, np.nan, 1e30))
                body = bytearray(values.tobytes())
        case _:
            body = bytearray(damaged_bytes(random, bytes(body), other))
    raw = header.encode("latin1", "replace")
    size = struct.pack("<I", len(raw)) if wide else struct.pack("<H", min(len(raw), 65535))
    return data[:8] + size + raw + bytes(body)


def damaged_zip(random: Random, data: bytes, other: bytes) -> bytes:
    """An .npz (or torch's archive) one of whose members is damaged, left out, twice there, or packed."""
    if random.random() < 0.12:
        return damaged_bytes(random, data, other)
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        members = [(info.filename, file.read(info)) for info in file.infolist()]
    at = random.randrange(len(members))
    name, content = members[at]
    spare = random.choice(members)[1]
    match random.randrange(12):
        case 0:
            del members[at]
        case 1:
            members.insert(random.randrange(len(members)), (name, spare))
        case 2:
            members[at] = (random.choice(("x.npy", name + "x", "../a.npy", "", name.upper())), content)
        case 3:
            out = io.BytesIO()
            np.save(out, np.zeros(random.choice((10, 10**6)), random.choice(("u1", "f2", "U3"))))
            members[at] = (name, out.getvalue())
        case _:
            members[at] = (name, _damaged_member(random, name, content, spare))
    out = io.BytesIO()
    packing = random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    with zipfile.ZipFile(out, "w", packing, compresslevel=1) as file:
        for name, content in members:
            file.writestr(zipfile.ZipInfo(name or "x"), content, packing)
    raw = out.getvalue()
    return damaged_bytes(random, raw, other) if random.random() < 0.08 else raw


def _damaged_member(random: Random, name: str, content: bytes, spare: bytes) -> bytes:
    if name.endswith("metadata.npy") and random.random() < 0.8:
        text = str(np.load(io.BytesIO(content), allow_pickle=False))
        out = io.BytesIO()
        np.save(out, np.array(damaged_json(random, text.encode(), b"{}").decode("utf-8", "replace")))
        return out.getvalue()
    if content[:6] == b"\x93NUMPY":
        return damaged_npy(random, content, spare)
    if name.endswith(".pkl"):
        return damaged_pickle(random, content, spare)
    return damaged_bytes(random, content, spare)


def damaged_pickle(random: Random, data: bytes, other: bytes) -> bytes:
    """A pickle with instructions left out, repeated, exchanged, or its values changed in another protocol."""
    try:
        codes = list(pickletools.genops(data))
    except Exception:
        return damaged_bytes(random, data, other)
    if random.random() < 0.3:
        return damaged_bytes(random, data, other)
    starts = [place or 0 for _, _, place in codes] + [len(data)]
    pieces = [data[a:b] for a, b in pairwise(starts)]
    for _ in range(random.choice((1, 1, 2, 4))):
        at = random.randrange(len(pieces))
        to = random.randrange(len(pieces))
        match random.randrange(6):
            case 0 if len(pieces) > 2:
                del pieces[at]
            case 1:
                pieces.insert(at, pieces[min(to, len(pieces) - 1)])
            case 2:
                pieces[at], pieces[to] = pieces[to], pieces[at]
            case 3:
                odd = (
                    b"cos\nsystem\n",
                    b"N",
                    b"K\x05",
                    b"]",
                    b"}",
                    b"(",
                    b"t",
                    b"R",
                    b"b",
                    b"\x85",
                    b"0",
                    b"2",
                    b"e",
                )
                pieces.insert(at, random.choice(odd))
            case 4:
                pieces[at] = pickle.dumps(
                    random.choice((None, 1e308, [1, 2], {"a": 1}, "x", b"x", 10**30)), 2
                )[2:-1]
            case _:
                pieces[at] = damaged_bytes(random, pieces[at][:4000], other[:4000])
    return b"".join(pieces)


def damaged_checkpoint(random: Random, data: bytes, other: bytes) -> bytes:
    """A checkpoint that is damaged within its seal, which is made right in most cases."""
    end = data.rfind(b"\nmotionloom sha256 ")
    content = (
        damaged_zip(random, data[:end], other)
        if random.random() < 0.8
        else damaged_bytes(random, data[:end], other)
    )
    if random.random() < 0.1:
        return content + data[end:]
    return content + f"\nmotionloom sha256 {hashlib.sha256(content).hexdigest()}\n".encode()


def damaged_safetensors(random: Random, data: bytes, other: bytes) -> bytes:
    """Safetensors with another header, whose length is right, or with other numbers."""
    if random.random() < 0.12:
        return damaged_bytes(random, data, other)
    end = 8 + int.from_bytes(data[:8], "little")
    header = data[8:end]
    body = data[end:]
    if random.random() < 0.7:
        header = _damaged_header(random, header)
    else:
        body = bytearray(body)
        for _ in range(random.choice((1, 4, 64))):
            at = random.randrange(max(1, len(body) // 4)) * 4
            body[at : at + 4] = random.choice(
                (b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\xff\xff\x7f\x7f", random.randbytes(4))
            )
        body = bytes(body[: len(data) - end])
    header += b" " * (-len(header) % 8)
    return len(header).to_bytes(8, "little") + header + body


def _damaged_header(random: Random, header: bytes) -> bytes:
    table: dict[str, Any] = json.loads(header)
    names = [name for name in table if name != "__metadata__"]
    name = random.choice(names)
    entry = dict(table[name])
    match random.randrange(6):
        case 0:
            entry["dtype"] = random.choice(
                ("F32", "F16", "BF16", "F64", "I8", "U8", "I64", "BOOL", "F8_E4M3", "C64", "X")
            )
        case 1:
            entry["shape"] = random.choice(
                ([0], [], [-1], [2**62], [*entry["shape"], 1], entry["shape"][::-1], [1, 2])
            )
        case 2:
            entry["data_offsets"] = random.choice(
                ([0, 0], [0, 4], [4, 0], table[random.choice(names)]["data_offsets"])
            )
        case 3:
            table[name + "x"] = table.pop(name)
            return json.dumps(table).encode()
        case 4 if "__metadata__" in table:
            odd = ("", "nan", "1e400", "{}", "[]", "null", "-5", "99999999999999999999", '{"a": NaN}')
            about = {key: random.choice((*odd, value + "x")) for key, value in table["__metadata__"].items()}
            return json.dumps({**table, "__metadata__": about}).encode()
        case _:
            return damaged_json(random, header, header)
    return json.dumps({**table, name: entry}).encode()


def damaged_tar(random: Random, data: bytes, other: bytes) -> bytes:
    """A shard with a header changed and its sum right, or the content of a member."""
    if random.random() < 0.15:
        return damaged_bytes(random, data, other)
    with tarfile.open(fileobj=io.BytesIO(data)) as file:
        members = [(info, file.extractfile(info).read()) for info in file]  # type: ignore[union-attr]
    at = random.randrange(len(members))
    info, content = members[at]
    match random.randrange(8):
        case 0:
            info.name = random.choice(
                (info.name + "x", "../" + info.name, "/etc/x.motion.npy", members[0][0].name, "x" * 99)
            )
        case 1:
            info.type = random.choice(
                (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.DIRTYPE, tarfile.CHRTYPE, b"x", b"L", b"g")
            )
            info.linkname = "/etc/passwd"
        case 2:
            members.insert(random.randrange(len(members)), members[at])
        case 3:
            del members[at]
        case _:
            how = damaged_npy if info.name.endswith(".npy") else damaged_json
            content = how(random, content, random.choice(members)[1])
            members[at] = (info, content)
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w", format=tarfile.USTAR_FORMAT) as file:
        for one, raw in members:
            one.size = len(raw)
            file.addfile(one, io.BytesIO(raw))
    raw = bytearray(out.getvalue())
    if random.random() < 0.2:  # a field of a header, with the header's sum made right
        head = 512 * random.randrange(len(raw) // 512)
        field = random.choice(((100, 8), (124, 12), (136, 12), (156, 1), (257, 8), (345, 16)))
        raw[head + field[0] : head + sum(field)] = random.choice(
            (b"7" * 12, b"\x80" + bytes(11), random.randbytes(12))
        )[: field[1]]
        raw[head + 148 : head + 156] = b" " * 8
        raw[head + 148 : head + 156] = b"%06o\0 " % sum(raw[head : head + 512])
    return bytes(raw)


def damaged_glb(random: Random, data: bytes, other: bytes) -> bytes:
    """A GLB with its JSON or its numbers changed; the lengths of its chunks are right."""
    if random.random() < 0.12:
        return damaged_bytes(random, data, other)
    length = int.from_bytes(data[12:16], "little")
    text = data[20 : 20 + length]
    rest = data[20 + length + 8 :]
    if random.random() < 0.7:
        text = damaged_json(random, text, text)
    else:
        values = np.frombuffer(rest[: len(rest) // 4 * 4], "<f4").copy()
        some = [random.randrange(len(values)) for _ in range(random.choice((1, 20)))]
        values[some] = random.choice((np.nan, np.inf, 1e30, 0, -1, 1e5))
        rest = values.tobytes()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(rest), b"BIN\0") + rest
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
