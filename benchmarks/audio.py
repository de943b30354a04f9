"""438-d audio features of one minute of sound: ours against separate calls of librosa's functions.

    OMP_NUM_THREADS=1 python -P benchmarks/audio.py [--fps 60] [--rounds 3] [--sound song.ogg] [--first-call]

Prints medians of CPU time of one run (a busy machine stretches wall time), the ratio, the floor
(the transforms alone, on arrays that are ready), the largest difference, what each takes of librosa's calls,
and the most memory this process has used. `--first-call` adds the CPU time of a first call in a new process,
where numba has compiled librosa on this machine and where it has not (a minute).
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from motionloom.datasets.audio import features as ours
from motionloom.datasets.audio import rhythm, spectra
from motionloom.datasets.audio.features import AudioSettings, audio_features, fitting_octaves
from motionloom.datasets.audio.sound import Sound

SECONDS = 60
FIRST_CALL = """
import numpy as np
from motionloom.datasets.audio.features import audio_features
audio_features(np.sin(np.arange(8 * 30720) / 9).astype(np.float32), 30720)
"""
STEPS: dict[str, list[tuple[Any, str]]] = {
    "mel, separation": [(ours, "separate")],
    "  of it medians": [(spectra, "_row_medians")],
    "chroma": [(ours, "_constant_q")],
    "  of it tuning": [(ours, "tuning")],
    "onsets": [(rhythm, "onset_strength")],
    "tempogram": [(rhythm, "tempogram")],
    "beats": [(rhythm, "track_beats")],
}

Seconds = dict[str, list[float]]


def timed(name: str, call: Callable[[], Any], into: Seconds) -> Any:
    """The call's result; its CPU time goes `into` the list of that name."""
    start = time.process_time()
    out = call()
    into[name].append(time.process_time() - start)
    return out


def published(y: NDArray[np.float32], sr: int, octaves: int, seconds: Seconds) -> NDArray[np.float32]:
    """Bailando's order of librosa calls, each of them on its own."""
    import librosa

    mel = timed("mel", lambda: librosa.feature.melspectrogram(y=y, sr=sr), seconds)
    mfcc = librosa.feature.mfcc(S=librosa.power_to_db(mel, ref=np.max))
    delta = librosa.feature.delta(mfcc, width=3)
    harmonic, percussive = timed("separation", lambda: librosa.effects.hpss(y), seconds)
    notes = timed("chroma", lambda: librosa.feature.chroma_cqt(y=harmonic, sr=sr, n_octaves=octaves), seconds)
    onsets = timed(
        "onsets", lambda: librosa.onset.onset_strength(y=percussive, sr=sr, aggregate=np.median), seconds
    )
    tempogram = timed("tempogram", lambda: librosa.feature.tempogram(onset_envelope=onsets, sr=sr), seconds)
    _, beats = timed("beats", lambda: librosa.beat.beat_track(onset_envelope=onsets, sr=sr), seconds)
    flags = np.zeros_like(onsets)
    flags[beats] = 1
    return np.concatenate([mfcc, delta, notes, onsets[None], flags[None], tempogram]).T


def steps_of(call: Callable[[], object]) -> dict[str, float]:
    """CPU seconds in our main functions during a call."""
    seconds: Seconds = defaultdict(list)
    plain = [(module, name, getattr(module, name)) for found in STEPS.values() for module, name in found]
    for step, found in STEPS.items():
        for module, name in found:
            real = getattr(module, name)

            def watched(*args: Any, real: Any = real, step: str = step, **keys: Any) -> Any:
                return timed(step, lambda: real(*args, **keys), seconds)

            setattr(module, name, watched)
    try:
        call()
    finally:
        for module, name, real in plain:
            setattr(module, name, real)
    return {step: sum(seconds[step]) for step in STEPS}


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
    """Three transforms of 2048 forward, two back, and one of 1024 an octave for chroma."""
    rng = np.random.default_rng(0)
    frame = rng.standard_normal((256, 2048)).astype(np.float32)
    short, spectrum = frame[:, :1024].copy(), fft.rfft(frame)

    def run() -> None:
        for _ in range(-(-frames // 256)):
            for _ in range(3):
                fft.rfft(frame)
            fft.irfft(spectrum), fft.irfft(spectrum)
            for _ in range(octaves):
                fft.rfft(short)

    return run


def first_call(cache: Path) -> float:
    """CPU seconds of a new process, from its start to the features of eight seconds of sound."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    subprocess.run([sys.executable, "-P", "-c", FIRST_CALL], check=True, env=environment)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--fps", type=float, default=60.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--sound", type=Path)
    parser.add_argument("--first-call", action="store_true")
    args = parser.parse_args()
    settings = AudioSettings(fps=args.fps)
    octaves = fitting_octaves(settings.rate)
    if args.sound:
        sound = Sound.read(args.sound, settings.rate).slice(0, SECONDS).samples
    else:
        sound = song(settings.rate, SECONDS)
    found = audio_features(sound, settings.rate, settings)
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{'memory of ours, at most':<32}{most:9.0f} MB")
    warnings.simplefilter("ignore")
    steps: Seconds = defaultdict(list)
    difference = np.abs(found - published(sound, settings.rate, octaves, steps))
    difference[~found[:, 40:52].any(axis=1), 40:52] = 0  # there librosa scales rounding up to notes
    steps.clear()
    times: Seconds = defaultdict(list)
    least = floor(len(found), octaves)
    for _ in range(args.rounds):
        timed("librosa", lambda: published(sound, settings.rate, octaves, steps), times)
        timed("ours", lambda: audio_features(sound, settings.rate, settings), times)
        timed("floor", least, times)
    median = {name: statistics.median(values) for name, values in times.items()}
    for name, seconds in median.items():
        print(f"{name:<32}{1000 * seconds:9.0f} ms")
    print(f"{'librosa / ours':<32}{median['librosa'] / median['ours']:9.1f}")
    print(f"{'ours / floor':<32}{median['ours'] / median['floor']:9.1f}")
    print(f"{'largest difference':<32}{difference.max():9.1e}")
    for name, values in steps.items():
        print(f"  librosa {name:<22}{1000 * statistics.median(values):9.0f} ms")
    for name, seconds in steps_of(lambda: audio_features(sound, settings.rate, settings)).items():
        print(f"  ours {name:<25}{1000 * seconds:9.0f} ms")
    if args.first_call:
        with tempfile.TemporaryDirectory() as folder:
            for name in ("nothing compiled", "compiled before"):
                print(f"{'first call, ' + name:<32}{first_call(Path(folder)):9.1f} s")


if __name__ == "__main__":
    main()
