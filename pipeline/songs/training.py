"""Training of the beat network: its losses, and batches of songs, augmented.

A batch is a pure function of (seed, number). Songs are mixed anew, their drums or all else silent for some
bars; played faster or slower, through other equalisers and compressors, under noise and fading, with parts of
the spectrum or of the time missing; some stretches are no music at all.

The target between two beats is not 0: a network that is never quite sure of the phase leaves the decoder
something to choose by.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits
from torch.utils.data import Dataset

from motionloom.datasets.audio.beat_net import BANDS, ROWS, levels
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.loading.plan import ALONE, BatchPlan, Share
from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.songs.songs import AnnotatedSong

_DOUBT = 0.1
"""Target of a beat midway between two."""
_GAINS = ((-2.0, 6.0), (-6.0, 5.0), (-4.0, 6.0))
"""Decibels of drums, bass and the others in a mix: mean and standard deviation."""
_WIDE = 1.5
"""Rows from a beat at which its target is 0; a row away it is one half."""


class BeatsModule(StageModule):
    """Trains a `BeatNet` by the binary cross-entropies of beats and of downbeats."""

    def losses(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """Return the losses; targets hold half of each beat in the rows beside it, as rows are not exact."""
        both = binary_cross_entropy_with_logits(self.net(batch["levels"]), batch["targets"], reduction="none")
        beat, downbeat = both.mean(dim=(0, 1)).unbind()
        return {"loss": beat + downbeat, "beat": beat, "downbeat": downbeat}


class SongBatches(Dataset[dict[str, Tensor]]):
    """Item k is one rank's rows of global batch k: "levels" [B, T, 64], "targets" [B, T, 2] of beats and
    downbeats, 0..1, and "length" [B], all T, by which a module counts the rows of a validation batch.
    """

    def __init__(
        self,
        songs: Sequence[AnnotatedSong],
        rows: int,
        batch: int,
        seed: int,
        share: Share = ALONE,
        *,
        augment: bool = True,
    ) -> None:
        shortest = min(song.stems.shape[1] for song in songs)
        if shortest < rows:
            raise UserError(f"window_seconds: {rows / ROWS:g} is longer than songs of {shortest / ROWS:g} s")
        self.songs = songs
        self.rows = rows
        self.augment = augment
        self.seed = seed
        self.share = share
        self.plan = BatchPlan(len(songs), batch, seed)

    def __len__(self) -> int:
        return self.plan.batches_per_epoch  # of validation; training asks for as many as it has steps

    def __getitem__(self, k: int) -> dict[str, Tensor]:
        turns, items = self.plan.local(k, self.share)
        cut = [
            self._stretch(self.songs[item], np.random.default_rng([self.seed, turn, item, 271]))
            for turn, item in zip(turns.tolist(), items.tolist(), strict=True)
        ]
        levels, targets = (torch.from_numpy(np.stack(part)) for part in zip(*cut, strict=True))
        return {"levels": levels, "targets": targets, "length": torch.full((len(cut),), self.rows)}

    def _stretch(
        self, song: AnnotatedSong, rng: np.random.Generator
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return a stretch's levels [rows, 64] and targets [rows, 2], played faster or slower."""
        mixed = levels(_mixed(song, rng if self.augment else None))
        speed = min(np.exp(rng.uniform(-0.16, 0.25)), len(mixed) / self.rows) if self.augment else 1.0
        places = rng.uniform(0, len(mixed) - speed * (self.rows - 1) - 1) + speed * np.arange(self.rows)
        # Levels between two rows are interpolated: playing faster is reading at other places.
        before = places.astype(np.int64)
        share = (places - before)[:, None].astype(np.float32)
        heard = (1 - share) * mixed[before] + share * mixed[np.minimum(before + 1, len(mixed) - 1)]
        beats = (song.beats * ROWS - places[0]) / speed
        between = _DOUBT * _targets((beats[1:] + beats[:-1]) / 2, self.rows)
        beat = np.maximum(_targets(beats, self.rows), between)
        targets = np.stack([beat, _targets(beats[song.downbeats], self.rows)], axis=1)
        if not self.augment:
            return heard, targets
        if rng.random() < 0.04:  # so that the network finds no beats where there are none
            return _no_music(self.rows, rng), np.zeros_like(targets)
        return _changed(heard, rng), targets


def _targets(beats: NDArray[np.float64], rows: int) -> NDArray[np.float32]:
    """Return targets [rows] of beats at rows, parts of rows included: 1 within half a row, falling to 0."""
    if not len(beats):
        return np.zeros(rows, dtype=np.float32)
    at = np.arange(rows)
    after = np.searchsorted(beats, at)
    near = [np.abs(at - beats[np.clip(place, 0, len(beats) - 1)]) for place in (after - 1, after)]
    return np.clip(_WIDE - np.minimum(*near), 0, 1).astype(np.float32)


def _mixed(song: AnnotatedSong, rng: np.random.Generator | None) -> NDArray[np.float32]:
    """Return a mix's power [T, 64], with drawn gains and silences, or all stems as loud as on average."""
    rows = song.stems.shape[1]
    gains = np.array([mean for mean, _ in _GAINS])[:, None] * np.ones(rows)
    if rng is not None and len(song.beats) > 8:
        gains += np.array([rng.normal(0.0, spread) for _, spread in _GAINS])[:, None]
        for _ in range(int(rng.choice([0, 1, 2], p=(0.4, 0.4, 0.2)))):
            # Somebody rests for four to sixteen bars: the drums, most often, or drums and bass, or all else.
            first = int(rng.integers(len(song.beats) - 4))
            last = min(len(song.beats) - 1, first + 4 * int(rng.choice([4, 4, 8, 16])))
            who = ([0], [0, 1], [1], [1, 2])[int(rng.choice(4, p=(0.6, 0.15, 0.1, 0.15)))]
            start, stop = (round(song.beats[beat] * ROWS) for beat in (first, last))
            gains[who, max(0, start - 2) : stop - 2] = -90.0
    power = 10.0 ** (song.stems.astype(np.float32) + gains[..., None].astype(np.float32) / 10)
    return np.asarray(power.sum(axis=0), dtype=np.float32)


def _changed(heard: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Return levels [T, 64] as of another recording: equaliser, fading, noise, missing bands and moments."""
    from scipy.ndimage import gaussian_filter1d

    rows = len(heard)
    across = np.arange(BANDS) / BANDS
    along = np.arange(rows) / rows
    out = heard + 0.3 * _curve(across, rng) + 0.2 * _curve(along, rng)[:, None]
    if rng.random() < 0.35:  # a compressor takes loudness back, as fast as it hears it
        loudness = gaussian_filter1d(out.mean(axis=1), float(np.exp(rng.uniform(0.5, 3.5))))
        out -= rng.uniform(0.3, 0.9) * loudness[:, None]
    if rng.random() < 0.4:  # noise of some colour, at a level between well below the music and almost in it
        floor = rng.uniform(-3.0, -0.3) + 0.5 * _curve(across, rng)
        grain = 0.2 * rng.standard_normal(out.shape)
        out = np.log10(10.0**out + 10.0 ** (floor + grain))
        out -= out.mean(axis=0)
    if rng.random() < 0.3:  # another pitch
        out = np.roll(out, int(rng.integers(-3, 4)), axis=1)
    if rng.random() < 0.3:  # a telephone, or a loudspeaker without bass
        width = int(rng.integers(2, BANDS // 2))
        start = int(rng.choice([0, int(rng.integers(BANDS - width)), BANDS - width]))
        out[:, start : start + width] = 0
    if rng.random() < 0.3:  # a dropout
        length = int(rng.integers(6, 90))
        start = int(rng.integers(rows - length)) if rows > length else 0
        out[start : start + length] = out.min() if rng.random() < 0.3 else 0
    return (out * rng.uniform(0.7, 1.3)).astype(np.float32)


def _no_music(rows: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return levels [T, 64] without a beat: noise, in which nothing or all kinds of events come and go."""
    from scipy.ndimage import gaussian_filter

    out = np.zeros((rows, BANDS))
    for _ in range(int(rng.integers(1, 4))):
        smooth = (float(np.exp(rng.uniform(-1.0, 3.0))), float(np.exp(rng.uniform(-1.0, 3.0))))
        part = gaussian_filter(rng.standard_normal(out.shape), smooth)
        out += rng.uniform(0.05, 0.8) * part / max(float(part.std()), 1e-6)
    return np.asarray(out - out.mean(axis=0), dtype=np.float32)


def _curve(at: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a smooth random curve over 0..1, of deviation about 1."""
    waves = np.arange(1, 4)[:, None]
    phases = rng.uniform(0, 2 * np.pi, (3, 1))
    return np.asarray((rng.standard_normal((3, 1)) / waves * np.cos(np.pi * waves * at + phases)).sum(axis=0))
