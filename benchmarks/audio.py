"""438-d audio features of one minute of sound: ours against librosa in the published order, in one run.

    OMP_NUM_THREADS=1 python -P benchmarks/audio.py [--fps 60] [--rounds 3]

Prints medians of CPU time (both run on one thread; a busy machine stretches wall time), the ratio, the floor
(the transforms alone, on arrays that are ready), the largest difference, where each spends its time, and
the wall time of a first call in a new process.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import statistics
import subprocess
import sys
import time
import warnings
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from motionloom.datasets.audio.chroma import fitting_octaves
from motionloom.datasets.audio.features import AudioSettings, audio_features

SECONDS = 60
PARTS = (
    "spectrum.spectra",
    "spectrum.mel_power",
    "spectrum.add",
    "median.running_median_valid",
    "chroma.chroma",
    "chroma.add",
    "rhythm.onset_strength",
    "rhythm.tempogram",
    "rhythm.track_beats",
)
FIRST_CALLS = {
    "ours": "from motionloom.datasets.audio.features import audio_features\naudio_features(sound, 30720)",
    "librosa": "from audio import Published\nPublished(7)(sound, 30720)",
}


class Published:
    """Bailando's order of librosa calls, and the seconds spent in each."""

    def __init__(self, octaves: int) -> None:
        self.octaves = octaves
        self.seconds: dict[str, list[float]] = defaultdict(list)

    def __call__(self, y: NDArray[np.float32], sr: int) -> NDArray[np.float32]:
        import librosa

        warnings.simplefilter("ignore")
        mel = self._timed("mel", lambda: librosa.feature.melspectrogram(y=y, sr=sr))
        mfcc = librosa.feature.mfcc(S=librosa.power_to_db(mel, ref=np.max))
        delta = librosa.feature.delta(mfcc, width=3)
        harmonic, percussive = self._timed("separation", lambda: librosa.effects.hpss(y))
        octaves = self.octaves
        notes = self._timed(
            "chroma", lambda: librosa.feature.chroma_cqt(y=harmonic, sr=sr, n_octaves=octaves)
        )
        onsets = self._timed(
            "onsets", lambda: librosa.onset.onset_strength(y=percussive, sr=sr, aggregate=np.median)
        )
        tempogram = self._timed("tempogram", lambda: librosa.feature.tempogram(onset_envelope=onsets, sr=sr))
        _, beats = self._timed("beats", lambda: librosa.beat.beat_track(onset_envelope=onsets, sr=sr))
        flags = np.zeros_like(onsets)
        flags[beats] = 1
        return np.concatenate([mfcc, delta, notes, onsets[None], flags[None], tempogram]).T

    def _timed(self, name: str, call: Callable):  # type: ignore[no-untyped-def]
        start = time.process_time()
        out = call()
        self.seconds[name].append(time.process_time() - start)
        return out


def song(rate: int, seconds: float) -> NDArray[np.float32]:
    """Drum noise and decaying notes at 112 beats a minute."""
    rng = np.random.default_rng(0)
    out = 0.01 * rng.standard_normal(int(seconds * rate))
    for beat in range(int(seconds * 112 / 60)):
        start = int(beat * 60 / 112 * rate)
        at = np.arange(min(len(out) - start, rate // 3)) / rate
        out[start : start + len(at)] += 0.3 * np.exp(-20 * at) * rng.standard_normal(len(at))
        out[start : start + len(at)] += (
            0.3 * np.exp(-6 * at) * np.sin(2 * np.pi * 55 * 2 ** (rng.integers(0, 36) / 12) * at)
        )
    return out.astype(np.float32)


def floor(frames: int, octaves: int) -> Callable[[], None]:
    """Three transforms of 2048 forward (two in float64), two back, and one of 1024 an octave for chroma."""
    rng = np.random.default_rng(0)
    double = rng.standard_normal((256, 2048))
    single, short = double.astype(np.float32), double[:, :1024].astype(np.float32)
    spectrum = fft.rfft(single)

    def run() -> None:
        for _ in range(-(-frames // 256)):
            fft.rfft(double), fft.rfft(double), fft.rfft(single)
            fft.irfft(spectrum), fft.irfft(spectrum)
            for _ in range(octaves):
                fft.rfft(short)

    return run


def by_file(call: Callable[[], object]) -> dict[str, float]:
    """Seconds in our main functions, what they call included (medians are part of `spectrum.add`)."""
    profile = cProfile.Profile()
    profile.runcall(call)
    shares: dict[str, float] = defaultdict(float)
    stats = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    names = ("spectrum.spectra", "spectrum.mel_power", "spectrum.add", "median.running_median_valid")
    names += (
        "chroma.chroma",
        "chroma.add",
        "rhythm.tempogram",
        "rhythm.track_beats",
        "rhythm.onset_strength",
    )
    for (path, _, function), (_, _, _, cumulative, _) in stats.items():
        name = f"{Path(path).stem}.{function}"
        if name in PARTS:
            shares[name] += cumulative
    return dict(sorted(shares.items(), key=lambda pair: -pair[1]))


def first_call(code: str) -> float:
    """Seconds of a new process from its start to the features of eight seconds of sound."""
    script = f"import numpy as np\nsound = np.sin(np.arange(8 * 30720) / 9).astype(np.float32)\n{code}"
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", script], check=True, cwd=Path(__file__).parent)
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--fps", type=float, default=60.0)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    settings = AudioSettings(fps=args.fps)
    octaves = fitting_octaves(settings.rate)
    sound = song(settings.rate, SECONDS)
    published = Published(octaves)
    least = floor(1 + len(sound) // 512, octaves)
    difference = np.abs(
        audio_features(sound, settings.rate, settings) - published(sound, settings.rate)
    ).max()
    published.seconds.clear()
    times: dict[str, list[float]] = defaultdict(list)
    for _ in range(args.rounds):
        for name, call in {
            "librosa": lambda: published(sound, settings.rate),
            "ours": lambda: audio_features(sound, settings.rate, settings),
            "floor": least,
        }.items():
            start = time.process_time()
            call()
            times[name].append(time.process_time() - start)
    median = {name: statistics.median(values) for name, values in times.items()}
    for name, seconds in median.items():
        print(f"{name:<32}{1000 * seconds:9.0f} ms")
    print(f"{'librosa / ours':<32}{median['librosa'] / median['ours']:9.1f}")
    print(f"{'ours / floor':<32}{median['ours'] / median['floor']:9.1f}")
    print(f"{'largest difference':<32}{difference:9.1e}")
    for name, values in published.seconds.items():
        print(f"  librosa {name:<22}{1000 * statistics.median(values):9.0f} ms")
    for name, seconds in by_file(lambda: audio_features(sound, settings.rate, settings)).items():
        print(f"  ours {name:<25}{1000 * seconds:9.0f} ms (profiled)")
    for name, code in FIRST_CALLS.items():
        print(f"first call, {name:<20}{first_call(code):9.1f} s")


if __name__ == "__main__":
    main()
