"""Sound files -> mono float32 samples, and resampling.

Notable choices:
- libsndfile decodes (WAV of 8, 16, 24, 32 bit and float, FLAC, OGG, MP3). It reads a WAV or an MP3 that was
  cut short without complaint, so headers are compared with the size of the file first.
- Where an MP3 does not state its length, libsndfile guesses it from the size and reads no further, which cuts
  varying bit rates short. From a pipe it reads to the end, and refuses one that ends within a frame.
- Sound is read, mixed to mono and resampled in blocks: memory is twice that of the samples that come out.
- Several channels become their mean. Float sound and lossy decoders overshoot a little: clipped to -1..1.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.mp3 import bytes_left, missing_bytes, sending_pipe, unheard
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import is_file

MAX_SECONDS = 3600
"""Longest sound that is read."""
MAX_RATE = 48_000
"""Sound of higher sample rates is brought to this one while it is read, unless another is asked for."""
_LAST_BLOCK = 0.05
"""Seconds that a decoder may lack of what a header states, as it does of whole and genuine OGG files."""
_SAMPLES_A_BYTE = 200
"""No music is packed so tightly (speech at 8 kbit/s has 48); beyond a minute of it, a file is a bomb."""

MAX_PEAK = 8.0
"""Float sound may overshoot 1; beyond this it is in another unit (integers stored as floats)."""

_BLOCK = 2**18
_UNKNOWN = 2**63 - 1
"""libsndfile's length of a pipe."""

_UNSTATED = (0xFFFFFFFF, 0x7FFFFFFF)
"""Lengths of the samples of a WAV that was written into a pipe; some writers take headers off, or round."""
_ROUNDED = 4096

_OTHER = "wav, flac, ogg and mp3 are read; convert others, as by: ffmpeg -i song.m4a song.wav"

_PART = re.compile(r"(?P<file>.+)@(?P<start>[\d:.]*+)(?P<dash>[-\u2013]?)(?P<end>[\d:.]*)", re.DOTALL)
_TIME = re.compile(r"(?:(?:(\d+):)?(\d+):)?(\d+(?:\.\d*)?)")

_LEAST, _BEYOND = 0.5, 0.5
"""Seconds of the shortest part (`0.10-0.20` is meant as minutes), and of what it may ask past the end."""


@dataclass(frozen=True)
class Excerpt:
    """A part of a sound file, by name: `song.mp3@0:30-1:00`, `song.mp3@45-`, `song.mp3@-1:20`.

    Times are seconds, m:ss or h:mm:ss. A file that is called just so, with its '@', is taken whole.
    """

    path: Path
    start: float = 0.0
    """Second where it begins."""
    end: float | None = None
    """Second where it ends; None is the end of the file."""

    @classmethod
    def named(cls, name: Path | str) -> Excerpt:
        """Parse a name; `UserError`, naming it, for times that are none."""
        whole = Path(name)
        match = _PART.fullmatch(str(name))
        if match is None or is_file(whole):
            return cls(whole)
        file, start, dash, end = match.group("file", "start", "dash", "end")
        if not dash or not (start or end):
            raise UserError(f"{name}: no such file; a part of {file} is written {Path(file).name}@0:30-1:00")
        first = _seconds(start or "0", name)
        last = None if not end else _seconds(end, name)
        if last is not None and last <= first:
            raise UserError(f"{name}: its end, {end}, is not after its start, {start}; swap them")
        if last is not None and last - first < _LEAST and "." in f"{start}{end}":
            meant = Path(file).name + f"@{start}-{end}".replace(".", ":")
            raise UserError(f"{name}: {last - first:g} s are no music; did you mean {meant}?")
        return cls(Path(file), first, last)

    @property
    def whole(self) -> bool:
        return not self.start and self.end is None

    def within(self, seconds: float, name: Path | str) -> tuple[float, float]:
        """Start and end in a sound so long; `UserError`, naming it `name`, where it is shorter."""
        if self.start >= seconds or (self.end is not None and self.end > seconds + _BEYOND):
            asked = f"{self.start:g} s to {'its end' if self.end is None else f'{self.end:g} s'}"
            raise UserError(f"{name} is {seconds:.1f} s long and {asked} was asked for; shorten it")
        return self.start, seconds if self.end is None else min(self.end, seconds)


def _seconds(time: str, name: Path | str) -> float:
    match = _TIME.fullmatch(time)
    hours, minutes, seconds = (float(part or 0) for part in match.groups()) if match else (0.0, 0.0, 60.0)
    if match is None or (":" in time and seconds >= 60) or (hours and minutes >= 60):
        raise UserError(f"{name}: {time} is no time; write seconds or m:ss, as song.mp3@0:30-1:00")
    return 3600 * hours + 60 * minutes + seconds


@dataclass(frozen=True, eq=False)
class Sound:
    """Mono sound: the raw form of music that motion is conditioned on."""

    samples: NDArray[np.float32]
    """[S], finite, -1..1."""
    rate: int
    """Samples a second."""
    piece: Sound | None = None
    """The longer sound that this is a slice of; features of music are made of whole pieces."""
    begin: float = 0.0
    """Second of the piece at which it begins."""
    analysed: dict[tuple[float, float, int, float | None], NDArray[np.float32]] = field(
        default_factory=dict, repr=False
    )
    """Features of the piece from a second on, at frames a second, by width (`features.features_of`)."""
    beats: NDArray[np.float64] | None = field(default=None, repr=False)
    """Seconds of the piece's beats, where somebody gives them (`given_beats`); None = as heard."""

    def __post_init__(self) -> None:
        samples = np.asarray(self.samples, dtype=np.float32)
        if samples.ndim != 1 or not np.isfinite(samples).all():
            raise UserError(f"sound must be finite mono samples [S], not of shape {list(samples.shape)}")
        if self.rate <= 0:
            raise UserError(f"sample rates must be positive, not {self.rate}")
        if len(samples) and (peak := max(samples.max(), -samples.min())) > 1:
            raise UserError(f"sound must lie between -1 and 1; it reaches {peak:.3g}")
        object.__setattr__(self, "samples", samples)

    @classmethod
    def read(cls, path: Path | str, rate: int | None = None) -> Sound:
        """Read a sound file or a part of one, as `song.mp3@0:30-1:00` (`Excerpt`), at its own sample rate
        or another one; `UserError` as of `read_sound`, and where the file is shorter.
        """
        part = Excerpt.named(path)
        samples, own_rate = read_sound(part.path, rate=rate)
        sound = cls(np.clip(samples, -1.0, 1.0), own_rate)
        return sound if part.whole else sound.slice(*part.within(sound.seconds, path))

    @property
    def seconds(self) -> float:
        return len(self.samples) / self.rate

    @property
    def silent(self) -> bool:
        """Whether the mean power is more than 70 dB below full scale [ours]."""
        return float(np.square(self.samples).mean()) < 1e-7

    def slice(self, start: float, end: float | None = None) -> Sound:
        """Return the sound from second `start` to `end`, or to its own end; the samples are not copied."""
        first = round(max(0.0, start) * self.rate)
        last = len(self.samples) if end is None else round(max(0.0, end) * self.rate)
        if np.isnan([start, end or 0.0]).any() or first >= min(last, len(self.samples)):
            raise UserError(
                f"nothing between second {start:g} and {'the end' if end is None else f'{end:g}'} of sound "
                f"of {self.seconds:.3f} s"
            )
        begin = self.begin + first / self.rate
        return Sound(self.samples[first:last], self.rate, self.piece or self, begin)

    def resampled(self, rate: int) -> Sound:
        """Return the sound at another sample rate."""
        samples = np.clip(resample_sound(self.samples, self.rate, rate), -1.0, 1.0)
        return Sound(samples, rate, self.piece, self.begin)


def read_sound(
    path: Path, name: str | None = None, *, rate: int | None = None
) -> tuple[NDArray[np.float32], int]:
    """A sound file -> (mono samples [n] in [-1, 1], rate in Hz): its own rate, or resampled to `rate`.

    A rate above `MAX_RATE` becomes that, unless `rate` is given; resampled sound may overshoot a little.
    `UserError` naming the file, or `name`, for sound that is missing, cut, damaged or not finite.
    """
    name = str(path) if name is None else name
    wanted, own_rate = _length(path, name)
    with _opened(path, name) as file:
        blocks = _mono(file, name, wanted)
        rate = rate or min(own_rate, MAX_RATE)
        if rate == own_rate:
            resampled = list(blocks)
        else:
            wanted = resampled_length(wanted, own_rate, rate)
            resampled = list(_resampled(blocks, own_rate, rate))
    samples = np.concatenate([np.empty(0, np.float32), *resampled])  # a damaged file may give no block
    missing = wanted - len(samples)  # the last block of a whole file, but no more
    if missing > min(_LAST_BLOCK * rate, wanted // 2):
        raise UserError(f"{name}: cut short: {len(samples)} samples of {wanted}")
    return np.pad(samples[:wanted], (0, max(0, missing))), rate


def sound_seconds(path: Path, name: str | None = None) -> float:
    """Length of a sound file, by its header or decoded; `UserError` where that shows a fault."""
    samples, rate = _length(path, str(path) if name is None else name)
    return samples / rate


def resample_sound(samples: NDArray[np.float32], rate_in: int, rate_out: int) -> NDArray[np.float32]:
    """Mono samples [n] from one rate to another by the SoX resampler at high quality.

    The same numbers and length, ceil(n * rate_out / rate_in), as `librosa.resample`, whose import takes
    seconds. Equal rates return the samples as they are.
    """
    import soxr

    # soxr rounds the length its own way; features count on librosa's.
    length = resampled_length(len(samples), rate_in, rate_out)
    if rate_in == rate_out:
        return samples
    resampled = soxr.resample(np.asarray(samples, dtype=np.float32), rate_in, rate_out, quality="HQ")
    out = np.zeros(length, dtype=np.float32)
    kept = min(len(out), len(resampled))
    out[:kept] = resampled[:kept]
    return out


def resampled_length(samples: int, rate_in: int, rate_out: int) -> int:
    """Samples that `resample_sound` makes of so many."""
    if rate_in <= 0 or rate_out <= 0:
        raise UserError(f"sample rates must be positive, not {rate_in} and {rate_out}")
    return -(-samples * rate_out // rate_in)


def _mono(file: Any, name: str, count: int) -> Iterator[NDArray[np.float32]]:
    """The first `count` samples as mono blocks [n], checked and clipped; tags after them are not decoded."""
    at = 0
    most = max(1, _BLOCK // file.channels)
    while len(block := file.read(min(most, count - at), dtype="float32", always_2d=True)):
        if (
            at % most
        ):  # libsndfile stops at a hole in an OGG; who reads on has another sound than who does not
            raise UserError(f"{name}: damaged at sample {at}")
        with np.errstate(all="ignore"):  # of float sound; it is looked at below
            samples = block.mean(axis=1)
        finite = np.isfinite(samples)
        if not finite.all():
            raise UserError(f"{name}: NaN or infinity at sample {at + int(np.argmin(finite))}")
        peak = float(np.abs(samples).max(initial=0))
        if peak > MAX_PEAK:
            raise UserError(f"{name}: samples reach {peak:.3g}; float sound lies between -1 and 1")
        at += len(samples)
        yield np.clip(samples, -1.0, 1.0)


def _resampled(
    blocks: Iterator[NDArray[np.float32]], rate_in: int, rate_out: int
) -> Iterator[NDArray[np.float32]]:
    """The blocks at another rate, with silence at the end for what rounding leaves out."""
    import soxr

    stream = soxr.ResampleStream(rate_in, rate_out, 1, dtype="float32", quality="HQ")
    for block in blocks:
        yield stream.resample_chunk(block)
    yield stream.resample_chunk(np.empty(0, dtype=np.float32), last=True)
    yield np.zeros(1, dtype=np.float32)


def _length(path: Path, name: str) -> tuple[int, int]:
    """(samples, rate) of a sound file; `UserError` for those that cannot be."""
    _check_header(path, name)
    with _opened(path, name) as file:
        samples = int(file.frames)
        rate = int(file.samplerate)
        if samples == _UNKNOWN:
            samples = sum(len(block) for block in _mono(file, name, MAX_SECONDS * rate + 1))
    if samples <= 0:
        raise UserError(f"{name}: no sound in it, or cut short (0 samples)")
    if samples > MAX_SECONDS * rate:
        raise UserError(f"{name}: {samples / rate:.0f} s; the longest sound read is {MAX_SECONDS} s; cut it")
    if samples > _SAMPLES_A_BYTE * path.stat().st_size + 60 * MAX_RATE:
        raise UserError(
            f"{name}: {samples} samples in {path.stat().st_size} bytes; no music is packed like that"
        )
    return samples, rate


@contextmanager
def _opened(path: Path, name: str) -> Iterator[Any]:
    """Return a `soundfile.SoundFile`, its length `_UNKNOWN` if an MP3 has none; `UserError` if unreadable."""
    import soundfile  # only data with sound pays for the import

    try:
        with unheard(), soundfile.SoundFile(path) as file:
            if file.format != "MP3":
                yield file
                return
            # Its length is a guess unless the first frame states it: a pipe has none, so libsndfile reads on.
            with sending_pipe(path) as end, soundfile.SoundFile(end, closefd=False) as piped:
                unstated = piped.frames == _UNKNOWN
                yield piped if unstated else file
                if unstated and not len(piped.read(1)) and (left := bytes_left(end)):
                    raise UserError(f"{name}: damaged: its decoder stops {left:,} bytes before the end")
    except (soundfile.SoundFileError, RuntimeError, OSError) as error:
        raise UserError(f"{name}: not readable sound ({_reason(error)})") from None


def _check_header(path: Path, name: str) -> None:
    """`UserError` for files that libsndfile reads without complaint: a WAV or MP3 that is cut short; and for
    missing and empty files. The content decides, not the suffix.
    """
    if not is_file(path):
        raise UserError(f"{name}: no such file")
    size = path.stat().st_size
    if size == 0:
        raise UserError(f"{name}: empty file (0 bytes)")
    with path.open("rb") as file:
        head = file.read(12)
        if head[:4] in (b"RIFF", b"RF64") and head[8:] == b"WAVE":
            # Chunks are walked up to the samples, of which there must be as many bytes as the file states.
            while len(chunk := file.read(8)) == 8:
                kind, length = struct.unpack("<4sI", chunk)
                start = file.tell()
                if kind == b"data":
                    # RF64 files, and those that were written into a pipe, state no length here.
                    stated = not any(most - _ROUNDED <= length <= most for most in _UNSTATED)
                    if stated and length > size - start:
                        raise UserError(
                            f"{name}: cut short: {size - start} bytes of sound, {length} expected"
                        )
                    return
                file.seek(start + length + length % 2)  # chunks lie at even places
            raise UserError(f"{name}: no data chunk, or cut short before it")
        if head == b"version http":
            raise UserError(f"{name}: a Git LFS pointer in place of the sound; fetch it: git lfs pull")
        if (missing := missing_bytes(file, size)) > 0:
            raise UserError(f"{name}: cut short: {missing} bytes of the MP3 are missing")


def _reason(error: Exception) -> str:
    """libsndfile's own words, without the path that soundfile puts before them, and clearer for some."""
    words = str(getattr(error, "error_string", error)).rstrip(".")
    if words.startswith(("File does not exist", "Format not recognised")):
        return f"of no known format; {_OTHER}"
    if words.startswith("Supported file format"):
        return f"damaged, or of an unknown kind; {_OTHER}"
    if words.startswith("Internal error"):
        return "its header states no sample rate or no channels"
    return "damaged or cut short" if words.startswith("Unspecified internal error") else words
