"""Music of our own for the dances of AIST++, whose songs may not be passed on: a band plays to each dance.

The tempo is known: AIST's pieces are numbered by it (Tsuchida et al., AIST Dance Video Database, ISMIR 2019:
six pieces a genre, 80 to 130 beats a minute by tens, house 110 to 135 by fives). The phase is not: where in
the piece an annotation begins is published nowhere. It is found in the dance. Kinematic beats are the minima
of the joints' mean speed, as in AI Choreographer (Li et al., ICCV 2021, section 4) and Bailando, whose
smoothing is used; the phase is that at which the tempo's grid meets most of them.
"""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.synth.music.song import Song

SMOOTHING = 5.0 / 60.0
"""Seconds, standard deviation of the Gaussian over the speed: Bailando's five frames at 60 fps."""
NEAR = 3.0 / 60.0
"""Seconds, the sigma of the Beat Align score: three frames at 60 fps."""
STEP = 0.001
"""Seconds between the phases that are tried."""

GENRES = {
    "BR": ("break dance", "hiphop"),
    "PO": ("pop dance", "disco"),
    "LO": ("lock dance", "disco"),
    "MH": ("middle hip-hop", "hiphop"),
    "LH": ("LA style hip-hop", "hiphop"),
    "HO": ("house dance", "house"),
    "WA": ("waack dance", "disco"),
    "KR": ("krump", "hiphop"),
    "JS": ("street jazz", "rock"),
    "JB": ("ballet jazz", "ballad"),
}
"""AIST's genres in words, and the band's: the same where it has one (house, hip-hop; waacking is danced to
disco, locking and popping to funk, its neighbour), else the nearest in character **[ours]**."""

TEMPI = {f"m{genre}{n}": 110 + 5 * n if genre == "HO" else 80 + 10 * n for genre in GENRES for n in range(6)}
"""Beats a minute of every piece."""


def kinematic_beats(
    joints: NDArray[np.floating], fps: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Seconds [K] and weights [K] of the kinematic beats of joints [T, N, 3].

    A minimum weighs as much as it is deep (its prominence), but none more than the median one: trembling then
    counts little, and a long stop no more than any other.
    """
    from scipy.ndimage import gaussian_filter1d
    from scipy.signal import find_peaks

    steps = np.linalg.norm(np.diff(np.asarray(joints, dtype=np.float64), axis=0), axis=-1).mean(1)
    speed = gaussian_filter1d(steps, SMOOTHING * fps)
    minima, found = find_peaks(-speed, prominence=0.0)
    depths = found["prominences"]
    # The step from one frame to the next belongs to the middle of both.
    return (minima + 0.5) / fps, np.minimum(depths, np.median(depths)) if len(depths) else depths


def phase_of(beats: NDArray[np.floating], weights: NDArray[np.floating], period: float) -> float:
    """Return the phase in [0, period) seconds of the grid of that period that best meets beats [K].

    It maximises the sum of weight * exp(-d^2 / (2 sigma^2)), d to the grid's nearest line and sigma that of
    Beat Align. Beats far from the grid, as between two of the music's, add nothing, while they would pull a
    mean; of phases that are equally good it is the first.
    """
    phases = np.arange(0.0, period, STEP)
    away = (np.asarray(beats)[None] - phases[:, None] + period / 2) % period - period / 2
    return float(phases[np.argmax((weights * np.exp(-(away**2) / (2 * NEAR**2))).sum(1))])


def song_for(sequence: str, genre: str, music: str, joints: NDArray[np.floating], fps: float) -> Song:
    """Return the song that the band plays to a dance, joints [T, N, 3]; a function of these and the name."""
    bpm = TEMPI[music]
    seed = int.from_bytes(hashlib.sha256(sequence.encode()).digest()[:4], "big")
    first = phase_of(*kinematic_beats(joints, fps), 60.0 / bpm)
    seconds = len(joints) / fps
    return Song(0, seed, GENRES[genre][1], bpm, seed % 12, seconds, played=True, first=first)
