"""Sound files -> mono float32 samples, and resampling.

Notable choices:
- libsndfile decodes (WAV of 8, 16, 24, 32 bit and float, FLAC, OGG, MP3), but it reads a WAV that was cut
  short without a word and takes any name for any format; both are checked here on the chunks of the file.
- Sound is read block by block, so memory follows what a file holds, not what its header claims.
- Several channels become their mean. Float sound and lossy decoders overshoot a little: clipped to -1..1.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.schema import UserError

MAX_SAMPLES = 2**28
"""Longest sound that is read: 93 minutes at 48 kHz, 1 GiB of memory."""

MAX_PEAK = 8.0
"""Float sound may overshoot 1; beyond this it is in another unit (integers stored as floats)."""

_BLOCK = 2**18
_WAV_SUFFIXES = (".wav", ".wave")


def read_sound(path: Path, name: str | None = None) -> tuple[NDArray[np.float32], int]:
    """A sound file -> (mono samples [n] in [-1, 1], rate in Hz).

    `UserError` naming the file for sound that is missing, cut short, empty, not what its name says, without
    a sample rate, or that holds NaN or infinity. `name` stands for the path in errors.
    """
    import soundfile  # only data with sound pays for the import

    name = str(path) if name is None else name
    check_sound_header(path, name)
    try:
        with soundfile.SoundFile(path) as file:
            claimed, rate = file.frames, int(file.samplerate)
            if claimed > MAX_SAMPLES:
                raise UserError(f"{name}: {claimed} samples; the longest sound read is {MAX_SAMPLES}")
            blocks = [
                block.mean(axis=1)
                for block in file.blocks(blocksize=_BLOCK, dtype="float32", always_2d=True)
                if len(block)
            ]
    except (soundfile.SoundFileError, RuntimeError, OSError) as error:
        raise UserError(f"{name}: not readable sound ({_reason(error)})") from None
    samples = np.concatenate(blocks) if blocks else np.empty(0, np.float32)
    if rate <= 0:
        raise UserError(f"{name}: sample rate {rate}")
    if len(samples) < claimed:
        raise UserError(f"{name}: cut short: {len(samples)} samples of {claimed}")
    if not len(samples):
        raise UserError(f"{name}: no sound in it (0 samples)")
    finite = np.isfinite(samples)
    if not finite.all():
        raise UserError(f"{name}: NaN or infinity at sample {int(np.argmin(finite))}")
    peak = float(np.abs(samples).max())
    if peak > MAX_PEAK:
        raise UserError(f"{name}: samples reach {peak:.3g}; float sound lies between -1 and 1")
    return np.clip(samples, -1.0, 1.0), rate


def sound_seconds(path: Path, name: str | None = None) -> float:
    """Length of a sound file by its header, without decoding it; `UserError` where that shows a fault."""
    import soundfile

    name = str(path) if name is None else name
    check_sound_header(path, name)
    try:
        info: Any = soundfile.info(path)
    except (soundfile.SoundFileError, RuntimeError, OSError) as error:
        raise UserError(f"{name}: not readable sound ({_reason(error)})") from None
    if info.frames <= 0 or info.samplerate <= 0:
        raise UserError(f"{name}: no sound in it ({info.frames} samples at {info.samplerate} Hz)")
    return float(info.frames / info.samplerate)


def _reason(error: Exception) -> str:
    """libsndfile's own words, without the path that soundfile puts before them."""
    return str(getattr(error, "error_string", error)).rstrip(".")


def resample_sound(samples: NDArray[np.float32], rate_in: int, rate_out: int) -> NDArray[np.float32]:
    """Mono samples [n] from one rate to another by the SoX resampler at high quality.

    The same numbers and length, ceil(n * rate_out / rate_in), as `librosa.resample`, whose import takes
    seconds. Equal rates return the samples as they are.
    """
    import soxr

    if rate_in <= 0 or rate_out <= 0:
        raise UserError(f"sample rates must be positive, not {rate_in} and {rate_out}")
    if rate_in == rate_out:
        return samples
    made = soxr.resample(np.asarray(samples, dtype=np.float32), rate_in, rate_out, quality="HQ")
    out = np.zeros(-(-len(samples) * rate_out // rate_in), dtype=np.float32)
    kept = min(len(out), len(made))
    out[:kept] = made[:kept]
    return out


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
