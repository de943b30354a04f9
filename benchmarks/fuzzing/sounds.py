"""Damage within sound files: frames of FLAC, pages of OGG and frames of MP3 whose checksums and lengths are
right, so that decoders go into them; chunks of WAV.
"""

from __future__ import annotations

import struct
from functools import lru_cache
from random import Random

from fuzzing.mutations import damaged_bytes


@lru_cache(maxsize=4)
def _table(polynomial: int, bits: int) -> tuple[int, ...]:
    out = []
    for byte in range(256):
        value = byte << (bits - 8)
        for _ in range(8):
            value = (value << 1) ^ (polynomial if value >> (bits - 1) else 0)
            value &= (1 << bits) - 1
        out.append(value)
    return tuple(out)


def _crc(data: bytes, polynomial: int, bits: int) -> int:
    """The checksum of FLAC (8 and 16 bits) and of OGG (32): high bit first, from 0."""
    table = _table(polynomial, bits)
    value = 0
    mask = (1 << bits) - 1
    for byte in data:
        value = ((value << 8) & mask) ^ table[(value >> (bits - 8)) ^ byte]
    return value


@lru_cache(maxsize=32)
def _flac_frames(data: bytes) -> tuple[int, tuple[tuple[int, int, int], ...]]:
    """End of the metadata; and start, end of the header and end of each frame."""
    at = 4
    last = False
    while not last:
        last = bool(data[at] & 128)
        at = at + 4 + int.from_bytes(data[at + 1 : at + 4], "big")
    starts = []
    place = data.find(b"\xff", at)
    while 0 <= place < len(data) - 16:
        if data[place + 1] & 0xFE == 0xF8:
            for length in range(5, 17):
                head = data[place : place + length]
                if _crc(head[:-1], 0x07, 8) == head[-1]:
                    starts.append((place, place + length))
                    break
        place = data.find(b"\xff", place + 1)
    # A sync within a frame's numbers is none: a frame ends in the sum of all of it.
    frames = []
    ends = [start for start, _ in starts] + [len(data)]
    begin = 0
    while begin < len(starts):
        for stop in range(begin + 1, len(ends)):
            frame = data[starts[begin][0] : ends[stop]]
            if _crc(frame[:-2], 0x8005, 16) == int.from_bytes(frame[-2:], "big"):
                frames.append((*starts[begin], ends[stop]))
                break
        begin = stop if frames and frames[-1][0] == starts[begin][0] else begin + 1
    return at, tuple(frames)


def damaged_flac(random: Random, data: bytes, other: bytes) -> bytes:
    """A FLAC with another header, or with frames damaged, left out or repeated, whose sums are right."""
    if random.random() < 0.12:
        return damaged_bytes(random, data, other)
    end, found = _flac_frames(data)
    head = bytearray(data[:end])
    frames = [[bytearray(data[a:b]), bytearray(data[b : c - 2])] for a, b, c in found]
    for _ in range(random.choice((1, 1, 2, 3))):
        at = random.randrange(len(frames)) if frames else 0
        match random.randrange(9):
            case 0:
                place = random.randrange(8, min(len(head), 42))
                head[place] = random.choice((0, 1, 255, head[place] ^ (1 << random.randrange(8))))
            case 1:
                place = random.randrange(4, len(head))
                head[place] ^= 1 << random.randrange(8)
            case 2 if frames:
                del frames[at : at + random.choice((1, 1, 1000))]
            case 3 if frames:
                frames.insert(random.randrange(len(frames)), [bytearray(part) for part in frames[at]])
            case 4 | 5 if frames:
                header = frames[at][0]
                place = random.randrange(2, len(header) - 1)
                header[place] ^= 1 << random.randrange(8)
            case _ if frames:
                body = frames[at][1]
                for _ in range(random.choice((1, 1, 3, 40))):
                    place = (
                        random.randrange(max(1, len(body))) if random.random() < 0.6 else random.randrange(3)
                    )
                    if place < len(body):
                        body[place] = random.choice((0, 255, body[place] ^ (1 << random.randrange(8))))
                if random.random() < 0.2:
                    del body[random.randrange(len(body) + 1) :]
    out = bytes(head)
    for header, body in frames:
        header[-1] = _crc(header[:-1], 0x07, 8)
        frame = bytes(header) + bytes(body)
        out += frame + _crc(frame, 0x8005, 16).to_bytes(2, "big")
    if random.random() < 0.25:
        out = out[: random.randrange(len(head), len(out) + 1)]
    return out


def damaged_ogg(random: Random, data: bytes, other: bytes) -> bytes:
    """An OGG with pages damaged, left out, repeated or exchanged, whose sums are right."""
    if random.random() < 0.12:
        return damaged_bytes(random, data, other)
    pages = []
    at = 0
    while data[at : at + 4] == b"OggS":
        count = data[at + 26]
        size = 27 + count + sum(data[at + 27 : at + 27 + count])
        pages.append(bytearray(data[at : at + size]))
        at += size
    for _ in range(random.choice((1, 1, 2, 3))):
        number = random.randrange(len(pages))
        page = pages[number]
        match random.randrange(8):
            case 0:
                del pages[number]
                if not pages:
                    return b""
            case 1:
                pages.insert(random.randrange(len(pages)), bytearray(page))
            case 2:
                to = random.randrange(len(pages))
                pages[number] = pages[to]
                pages[to] = page
            case 3:
                place = random.choice((4, 5, *range(6, 22), 26))
                page[place] = random.choice((0, 1, 2, 4, 255, page[place] ^ (1 << random.randrange(8))))
            case _:
                for _ in range(random.choice((1, 1, 4, 64))):
                    place = random.randrange(27, len(page)) if len(page) > 27 else 5
                    page[place] = random.choice((0, 255, page[place] ^ (1 << random.randrange(8))))
    out = b""
    for page in pages:
        page[22:26] = bytes(4)
        page[22:26] = _crc(bytes(page), 0x04C11DB7, 32).to_bytes(4, "little")
        out += bytes(page)
    return out[: random.randrange(1, len(out) + 1)] if random.random() < 0.15 else out


_RATES = (0, 32, 40, 48, 56, 64, 80, 96, 112, 128, 160, 192, 224, 256, 320)
_RATES_2 = (0, 8, 16, 24, 32, 40, 48, 56, 64, 80, 96, 112, 128, 144, 160)


@lru_cache(maxsize=32)
def _mp3_frames(data: bytes) -> tuple[tuple[int, int], ...]:
    """Start and end of each frame of layer III."""
    frames = []
    at = max(0, data.find(b"\xff"))
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] & 0xE6 == 0xE2:
        first = data[at + 1] & 0x18 == 0x18
        half = {0x18: 0, 0x10: 1, 0x00: 2}.get(data[at + 1] & 0x18, 0)
        rate = (44100, 48000, 32000, 1)[data[at + 2] >> 2 & 3] >> half
        bits = (_RATES if first else _RATES_2)[min(data[at + 2] >> 4, 14)]
        size = (144 if first else 72) * 1000 * bits // rate + (data[at + 2] >> 1 & 1)
        if size < 24:
            break
        frames.append((at, min(at + size, len(data))))
        at += size
    return tuple(frames)


def damaged_mp3(random: Random, data: bytes, other: bytes) -> bytes:
    """An MP3 with frames damaged behind their heads, left out or repeated, or with another tag or length."""
    found = _mp3_frames(data)
    if random.random() < 0.12 or len(found) < 3:
        return damaged_bytes(random, data, other)
    head = data[: found[0][0]]
    frames = [bytearray(data[a:b]) for a, b in found]
    for _ in range(random.choice((1, 1, 2, 3))):
        at = random.randrange(len(frames))
        frame = frames[at]
        match random.randrange(9):
            case 0 if len(frames) > 2:
                del frames[at : at + random.choice((1, 1, 1000))]
                frames = frames or [frame]
            case 1:
                frames.insert(random.randrange(len(frames)), bytearray(frame))
            case 2:
                frame[random.choice((1, 2, 3))] ^= 1 << random.randrange(8)
            case 3:
                place = max(frames[0].find(b"Xing"), frames[0].find(b"Info"))
                if place >= 0:
                    where = place + random.randrange(4, 20)
                    if where < len(frames[0]):
                        frames[0][where] = random.choice((0, 1, 255, random.randrange(256)))
            case 4:
                head = (
                    b"ID3"
                    + bytes(random.choice(((4, 0, 0, 0, 0, 0, 9), (3, 0, 16, 127, 127, 127, 127))))
                    + bytes(9)
                )
            case _:
                for _ in range(random.choice((1, 1, 4, 64))):
                    place = (
                        random.randrange(4, min(len(frame), 36))
                        if random.random() < 0.5
                        else random.randrange(4, len(frame))
                    )
                    frame[place] = random.choice((0, 255, frame[place] ^ (1 << random.randrange(8))))
    out = head + b"".join(frames) + data[found[-1][1] :]
    return out[: random.randrange(1, len(out) + 1)] if random.random() < 0.15 else out


def damaged_wav(random: Random, data: bytes, other: bytes) -> bytes:
    """A WAV with its chunks changed, exchanged or repeated; lengths are right or are the damage."""
    if random.random() < 0.2:
        return damaged_bytes(random, data, other)
    chunks = []
    at = 12
    while at + 8 <= len(data):
        size = int.from_bytes(data[at + 4 : at + 8], "little")
        chunks.append((data[at : at + 4], bytearray(data[at + 8 : at + 8 + size])))
        at += 8 + size + size % 2
    number = random.randrange(len(chunks))
    kind, body = chunks[number]
    match random.randrange(7):
        case 0:
            del chunks[number]
        case 1:
            chunks.insert(
                random.randrange(len(chunks) + 1), (random.choice((kind, b"LIST", b"fmt ", b"data")), body)
            )
        case 2:
            chunks.reverse()
        case 3 | 4:
            layout = next(body for name, body in chunks if name == b"fmt ")
            place = random.randrange(len(layout))
            layout[place] = random.choice(
                (0, 1, 2, 3, 16, 24, 32, 255, layout[place] ^ (1 << random.randrange(8)))
            )
        case 5:
            for _ in range(random.choice((1, 9, 90))):
                if body:
                    body[random.randrange(len(body))] = random.choice((0, 255, 127, 128))
        case _:
            del body[random.randrange(len(body) + 1) :]
    inside = b"WAVE"
    for name, content in chunks:
        size = (
            len(content)
            if random.random() < 0.93
            else random.choice((0, 1, len(content) + 9, 2**31, 2**32 - 1))
        )
        inside += name + struct.pack("<I", size) + bytes(content) + b"\0" * (len(content) % 2)
    return random.choice((b"RIFF",) * 9 + (b"RF64",)) + struct.pack("<I", len(inside)) + inside
