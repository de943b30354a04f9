"""What libsndfile lets pass: files that are missing, empty, cut short, or not what their name says.

It reads a WAV or an MP3 that was cut short without a word, takes any name for any format, and guesses the
length of an MP3 of varying bit rate that does not state it. The chunks of a WAV and the frames of an MP3 say
what a file really holds.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

from motionloom.datasets.schema import UserError

_WAV_SUFFIXES = (".wav", ".wave")

_BITRATES = (
    (32, 40, 48, 56, 64, 80, 96, 112, 128, 160, 192, 224, 256, 320),
    (8, 16, 24, 32, 40, 48, 56, 64, 80, 96, 112, 128, 144, 160),
)
"""kbit/s of layer III by the index in a frame's header, from 1: MPEG 1, then MPEG 2 and 2.5."""

_RATES = {3: (44100, 48000, 32000), 2: (22050, 24000, 16000), 0: (11025, 12000, 8000)}
"""Hz by the version in a frame's header."""


def check_sound_header(path: Path, name: str | None = None) -> None:
    """`UserError` for what libsndfile lets pass: a missing or empty file, a `.wav` that is none or is cut."""
    name = str(path) if name is None else name
    if not path.is_file():
        raise UserError(f"{name}: no such file")
    size = path.stat().st_size
    if size == 0:
        raise UserError(f"{name}: empty file (0 bytes)")
    with path.open("rb") as file:
        head = file.read(12)
        if head[:4] in (b"RIFF", b"RF64") and head[8:] == b"WAVE":
            _check_wave_chunks(file, name, size)
        elif path.suffix.lower() in _WAV_SUFFIXES:
            raise UserError(f"{name}: not a WAV file (it does not begin with RIFF ... WAVE)")


def _check_wave_chunks(file: BinaryIO, name: str, size: int) -> None:
    """Walk the chunks up to the samples: a format with a rate, and as many bytes as the file promises."""
    long_data: int | None = None
    formatted = False
    while len(head := file.read(8)) == 8:
        kind, length = struct.unpack("<4sI", head)
        start = file.tell()
        if kind == b"ds64":  # 64-bit lengths of RF64
            body = file.read(min(length, 16))
            long_data = struct.unpack("<Q", body[8:16])[0] if len(body) == 16 else None
        elif kind == b"fmt ":
            body = file.read(min(length, 16))
            if len(body) < 16:
                raise UserError(f"{name}: the format chunk is cut short")
            channels, rate = struct.unpack("<HI", body[2:8])
            if not rate:
                raise UserError(f"{name}: sample rate 0")
            if not channels:
                raise UserError(f"{name}: 0 channels")
            formatted = True
        elif kind == b"data":
            if long_data is not None and length == 0xFFFFFFFF:
                length = long_data
            if not formatted:
                raise UserError(f"{name}: samples before the format chunk")
            if not length:
                raise UserError(f"{name}: no sound in it (0 samples)")
            if length > size - start:
                raise UserError(f"{name}: cut short: {size - start} bytes of sound, {length} expected")
            return
        file.seek(start + length + length % 2)  # chunks lie at even places
    raise UserError(f"{name}: no data chunk, or cut short before it")


def mp3_samples(path: Path) -> tuple[int, bool] | None:
    """(samples in the frames of an MP3, whether it states its length); None where anything else lies between.

    A first frame that states the length holds no sound, and encoders add silence: the sound is up to some
    thousand samples shorter.
    """
    samples, size, stated = 0, path.stat().st_size, False
    with path.open("rb") as file:
        head = file.read(10)
        at = 0
        if head[:3] == b"ID3" and len(head) == 10:  # length in four bytes of seven bits
            at = 10 + sum((byte & 127) << 7 * (3 - i) for i, byte in enumerate(head[6:10]))
        while at + 4 <= size:
            file.seek(at)
            frame = _mp3_frame(file.read(4))
            if frame is None:
                file.seek(at)
                ended = file.read(8).startswith((b"TAG", b"APETAGEX", b"LYRICSBE"))
                return (samples, stated) if ended and samples else None
            length, count = frame
            if not samples:
                first = file.read(length)
                stated = any(word in first for word in (b"Xing", b"Info", b"VBRI"))
            if at + length > size:
                break
            at, samples = at + length, samples + count
    return (samples, stated) if samples else None


def _mp3_frame(head: bytes) -> tuple[int, int] | None:
    """(bytes, samples) of a frame of layer III by its header; None for anything else."""
    (bits,) = struct.unpack(">I", head)
    version, layer = bits >> 19 & 3, bits >> 17 & 3
    bitrate, rate = bits >> 12 & 15, bits >> 10 & 3
    if bits >> 21 != 0x7FF or version == 1 or layer != 1 or bitrate in (0, 15) or rate == 3:
        return None
    samples = 1152 if version == 3 else 576
    kilobits, hertz = _BITRATES[version != 3][bitrate - 1], _RATES[version][rate]
    return samples // 8 * kilobits * 1000 // hertz + (bits >> 9 & 1), samples
