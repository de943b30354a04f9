"""What a sound is: music, or silence, speech or noise, which nobody dances to [ours].

The evidence is the median over windows of six seconds, in which music repeats itself and words do not:

- level; below -70 dB of full scale nothing is heard;
- beat: how much the onsets resemble themselves one beat later, 0..1 (no onset does in speech and noise);
- steady: the share of the tones that stay where they are for 0.3 s, as those of a speaking voice do not;
- syllables: the share of the changes in loudness that come 3 to 8 times a second;
- gaps: the share of moments that are half as loud as what is around them;
- flatness: how much the share of noise in the spectrum changes, dB; that of noise does not.

What is doubtful is music: a dance to speech is less of a nuisance than a song that is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.sound import Sound

Kind = Literal["music", "silence", "speech", "noise"]

RATE = 16_000
_FFT, _HOP = 1024, 160
_FPS = RATE // _HOP
_WINDOW = 6 * _FPS
"""Frames looked at together."""
_MOST = 8
"""Windows; those of longer sounds lie apart."""
_SHORTEST = 3.0
"""Seconds; what is shorter can be silent, and is music otherwise."""

QUIET_DB = -70.0
BEAT = 0.3
"""Speech reaches 0.28 and noise 0.2; music with drums has 0.5 and more.
"""
STEADY = 0.3
NOISE_STEADY = 0.1
SYLLABLES = 0.33
GAPS = 0.2
FLATNESS_DB = 2.0


@dataclass(frozen=True)
class Heard:
    """What a sound is."""

    kind: Kind

    @property
    def sentence(self) -> str:
        """For the person who asked; empty of music."""
        return _SENTENCES[self.kind]


_SENTENCES: dict[Kind, str] = {
    "music": "",
    "silence": "nothing is heard",
    "speech": "speech and no music is heard",
    "noise": "noise and no music is heard",
}
_known: WeakKeyDictionary[Sound, Heard] = WeakKeyDictionary()


@dataclass(frozen=True)
class Evidence:
    """What the kind of a sound is decided by; the module says what the numbers are."""

    beat: float
    steady: float
    syllables: float
    gaps: float
    flatness: float

    @property
    def kind(self) -> Kind:
        if self.beat >= BEAT or self.steady >= STEADY:
            return "music"
        if self.syllables >= SYLLABLES and self.gaps >= GAPS:
            return "speech"
        return "noise" if self.flatness < FLATNESS_DB and self.steady < NOISE_STEADY else "music"


def heard(sound: Sound) -> Heard:
    """The kind of a sound by all of it; it is listened to once."""
    if sound in _known:
        return _known[sound]
    if _decibels(float(np.square(sound.samples).mean())) < QUIET_DB:
        kind: Kind = "silence"
    else:
        found = evidence(sound) if sound.seconds >= _SHORTEST else None
        kind = "music" if found is None else found.kind
    _known[sound] = Heard(kind)
    return _known[sound]


def evidence(sound: Sound) -> Evidence:
    """Measured on at most eight windows of a sound of three seconds or more that is not silent."""
    samples = sound.resampled(RATE).samples
    samples = samples / np.sqrt(np.square(samples).mean())  # how loud it is plays no part
    length = min(_WINDOW * _HOP + _FFT, len(samples))
    count = min(_MOST, max(1, len(samples) // length))
    starts = np.linspace(0, len(samples) - length, count).astype(int)
    rows = np.array([_measured(samples[start : start + length]) for start in starts])
    return Evidence(*np.median(rows, axis=0).tolist())


def _measured(samples: NDArray[np.float32]) -> tuple[float, float, float, float, float]:
    """The fields of `Evidence` of one window [n]."""
    from scipy.ndimage import uniform_filter1d

    frames = np.lib.stride_tricks.sliding_window_view(samples, _FFT)[::_HOP]
    power = np.square(np.abs(np.fft.rfft(frames * np.hanning(_FFT), axis=1)))[:, 4:] + 1e-12  # above 60 Hz
    loudness = power.sum(axis=1)
    edges = np.unique(np.geomspace(4, power.shape[1], 21).astype(int))[:-1]
    bands = np.add.reduceat(power, edges, axis=1)
    rms = np.sqrt(loudness)
    flat = 10 * np.log10(np.exp(np.log(power).mean(axis=1)) / power.mean(axis=1))
    return (
        _beat(np.log(bands + 1e-6 * bands.max())),
        _steady(power),
        _syllables(np.sqrt(bands)),
        float(np.mean(rms < 0.5 * uniform_filter1d(rms, _FPS))),
        float(flat[loudness > 1e-3 * loudness.max()].std()),
    )


def _beat(bands: NDArray[np.float64]) -> float:
    """Largest autocorrelation of the rise of log power [T, N], at 40 to 200 beats a minute."""
    from scipy.ndimage import uniform_filter1d

    rise = np.maximum(0, np.diff(uniform_filter1d(bands, 3, axis=0), axis=0)).mean(axis=1)
    rise -= uniform_filter1d(rise, _FPS)
    alike = np.correlate(rise, rise, "full")[len(rise) - 1 :] / (np.square(rise).sum() + 1e-12)
    alike *= len(rise) / np.arange(len(rise), 0, -1)
    return float(alike[round(0.3 * _FPS) : round(1.5 * _FPS)].max())


def _steady(power: NDArray[np.float64]) -> float:
    """Share of the peaks' amplitude in peaks that are at one place for 0.3 s, of power [T, F]."""
    from scipy.ndimage import maximum_filter1d, median_filter, uniform_filter1d

    level = 10 * np.log10(power)
    peaks = (level > median_filter(level, (1, 21)) + 9) & (level > level.max() - 50)
    peaks &= level >= maximum_filter1d(level, 3, axis=1)
    near = maximum_filter1d(peaks.astype(np.float32), 3, axis=1)
    amplitude = np.sqrt(power) * peaks
    kept = amplitude[uniform_filter1d(near, round(0.3 * _FPS), axis=0) > 0.9]
    return float(kept.sum() / (amplitude.sum() + 1e-12))


def _syllables(bands: NDArray[np.float64]) -> float:
    """Share of the modulation of 0.5 to 30 Hz that is of 3 to 8 Hz, of amplitudes [T, N]."""
    changes = (bands - bands.mean(axis=0)) * np.hanning(len(bands))[:, None]
    found = np.square(np.abs(np.fft.rfft(changes, axis=0)))
    hertz = np.fft.rfftfreq(len(bands), 1 / _FPS)
    share = found[(hertz >= 3) & (hertz < 8)].sum(axis=0) / (
        found[(hertz >= 0.5) & (hertz < 30)].sum(axis=0) + 1e-12
    )
    return float(share.mean())


def _decibels(power: float) -> float:
    return 10 * float(np.log10(power + 1e-12))
