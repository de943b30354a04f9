"""Sound files -> mono float32 samples, and resampling.

Notable choices:
- libsndfile decodes (WAV of 8, 16, 24, 32 bit and float, FLAC, OGG, MP3); what it lets pass is caught by
  `headers`.
- Sound is read, mixed to mono and resampled in blocks: memory is twice that of the samples that come out.
- Several channels become their mean. Float sound and lossy decoders overshoot a little: clipped to -1..1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.headers import check_sound_header, mp3_samples
from motionloom.datasets.schema import UserError

MAX_SAMPLES = 2**28
"""Longest sound that is read: 93 minutes at 48 kHz, 1 GiB of memory."""

MAX_PEAK = 8.0
"""Float sound may overshoot 1; beyond this it is in another unit (integers stored as floats)."""

_BLOCK = 2**18

_MP3_SLACK = 4 * 1152
"""Samples that an MP3's frames may hold more than its sound: a description, and silence at both ends."""


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
    def read(cls, path: Path | str, rate: int | None = None) -> Self:
        """A sound file, at its own sample rate or another one; `UserError` as of `read_sound`."""
        samples, found = read_sound(Path(path), rate=rate)
        return cls(np.clip(samples, -1.0, 1.0), found)

    @property
    def seconds(self) -> float:
        """Its length."""
        return len(self.samples) / self.rate

    def slice(self, start: float, end: float | None = None) -> Sound:
        """From second `start` to second `end`, or as far as there is sound; the samples are not copied."""
        first = round(max(0.0, start) * self.rate)
        last = len(self.samples) if end is None else round(max(0.0, end) * self.rate)
        if first >= min(last, len(self.samples)):
            raise UserError(
                f"nothing between second {start:g} and {'the end' if end is None else f'{end:g}'} of sound "
                f"of {self.seconds:.3f} s"
            )
        begin = self.begin + first / self.rate
        return Sound(self.samples[first:last], self.rate, self.piece or self, begin)

    def resampled(self, rate: int) -> Sound:
        """The same sound at another sample rate."""
        samples = np.clip(resample_sound(self.samples, self.rate, rate), -1.0, 1.0)
        return Sound(samples, rate, self.piece, self.begin)


def read_sound(
    path: Path, name: str | None = None, *, rate: int | None = None
) -> tuple[NDArray[np.float32], int]:
    """A sound file -> (mono samples [n] in [-1, 1], rate in Hz): its own rate, or resampled to `rate`.

    Resampled sound may overshoot a little. `UserError` naming the file for sound that is missing, cut short,
    empty, not what its name says, without a sample rate, or that holds NaN or infinity. `name` stands for the
    path in errors.
    """
    import soundfile  # only data with sound pays for the import

    name = str(path) if name is None else name
    check_sound_header(path, name)
    try:
        with soundfile.SoundFile(path) as file:
            found = int(file.samplerate)
            wanted = _length(path, name, file.frames, found, file.format)
            blocks = _mono(file, name, wanted)
            if rate is None or rate == found:
                made = list(blocks)
            else:
                wanted = resampled_length(wanted, found, rate)
                made = list(_resampled(blocks, found, rate))
    except (soundfile.SoundFileError, RuntimeError, OSError) as error:
        raise UserError(f"{name}: not readable sound ({_reason(error)})") from None
    samples = np.concatenate(made)
    if len(samples) < wanted:
        raise UserError(f"{name}: cut short: {len(samples)} samples of {wanted}")
    return samples[:wanted], rate or found


def require_audible(samples: NDArray[np.float32], path: Path | str, *, quietest: float = 1e-4) -> None:
    """`UserError` naming the file where no sample [n] reaches `quietest` (-80 dB of full scale, **[ours]**).

    Only for music that a motion is asked for: features of silence can be computed, and data may hold it.
    """
    peak = float(max(samples.max(), -samples.min())) if len(samples) else 0.0
    if peak < quietest:
        raise UserError(f"{path}: silent (its loudest sample is {peak:.2g}): give music that can be heard")


def sound_seconds(path: Path, name: str | None = None) -> float:
    """Length of a sound file by its header, without decoding it; `UserError` where that shows a fault."""
    import soundfile

    name = str(path) if name is None else name
    check_sound_header(path, name)
    try:
        info: Any = soundfile.info(path)
    except (soundfile.SoundFileError, RuntimeError, OSError) as error:
        raise UserError(f"{name}: not readable sound ({_reason(error)})") from None
    return _length(path, name, info.frames, info.samplerate, info.format) / float(info.samplerate)


def resample_sound(samples: NDArray[np.float32], rate_in: int, rate_out: int) -> NDArray[np.float32]:
    """Mono samples [n] from one rate to another by the SoX resampler at high quality.

    The same numbers and length, ceil(n * rate_out / rate_in), as `librosa.resample`, whose import takes
    seconds. Equal rates return the samples as they are.
    """
    import soxr

    length = resampled_length(len(samples), rate_in, rate_out)
    if rate_in == rate_out:
        return samples
    made = soxr.resample(np.asarray(samples, dtype=np.float32), rate_in, rate_out, quality="HQ")
    out = np.zeros(length, dtype=np.float32)
    kept = min(len(out), len(made))
    out[:kept] = made[:kept]
    return out


def resampled_length(samples: int, rate_in: int, rate_out: int) -> int:
    """Samples that `resample_sound` makes of so many."""
    if rate_in <= 0 or rate_out <= 0:
        raise UserError(f"sample rates must be positive, not {rate_in} and {rate_out}")
    return -(-samples * rate_out // rate_in)


def _mono(file: Any, name: str, count: int) -> Iterator[NDArray[np.float32]]:
    """The first `count` samples as mono blocks [n], checked and clipped; tags behind them are not decoded."""
    at = 0
    for block in file.blocks(blocksize=_BLOCK, frames=count, dtype="float32", always_2d=True):
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


def _length(path: Path, name: str, claimed: int, rate: int, kind: str) -> int:
    """Samples of sound; `UserError` for a length that cannot be, or that the file does not bear out."""
    if rate <= 0:
        raise UserError(f"{name}: sample rate {rate}")
    if claimed <= 0:
        raise UserError(f"{name}: no sound in it, or cut short (0 samples)")
    if claimed > MAX_SAMPLES:
        raise UserError(f"{name}: {claimed} samples; the longest sound read is {MAX_SAMPLES}")
    if kind != "MP3" or (frames := mp3_samples(path)) is None:
        return claimed
    there, stated = frames
    if stated and there < claimed:
        raise UserError(f"{name}: cut short: {there} samples of {claimed}")
    if not stated and there > claimed + max(_MP3_SLACK, there // 50):
        raise UserError(
            f"{name}: an MP3 of varying bit rate that does not state its length; write it as WAV or FLAC"
        )
    return min(there, claimed)  # an unstated length is a guess from the size, which tags add to


def _reason(error: Exception) -> str:
    """libsndfile's own words, without the path that soundfile puts before them; two of them say nothing."""
    words = str(getattr(error, "error_string", error)).rstrip(".")
    if words.startswith("File does not exist"):
        return "of no known format"
    return "damaged" if words.startswith("Unspecified internal error") else words
