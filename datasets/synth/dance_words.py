"""Captions of dances to songs: the style of the legs, the genre and the tempo, in several wordings."""

from __future__ import annotations

import numpy as np

from motionloom.datasets.synth.dance_plan import DanceTruth
from motionloom.datasets.synth.genres import GENRES

_WHO = ("a person", "a man", "a woman", "someone", "the dancer", "a figure")
_STYLES = {
    "step": ("steps from side to side", "dances with steps to either side"),
    "bounce": ("bounces up and down", "dances by bouncing in the knees"),
    "sway": ("sways from side to side", "dances with swaying hips"),
}
_TEMPO = {"slow": ("slow ", ""), "moderate": ("", "steady "), "fast": ("fast ", "quick ")}


def dance_captions(truth: DanceTruth, rng: np.random.Generator, number: int) -> list[str]:
    """`number` different captions, or as many as there are wordings."""
    found: list[str] = []
    for _ in range(8 * number):
        text = _sentence(truth, rng)
        if text not in found:
            found.append(text)
        if len(found) == number:
            break
    return found


def _sentence(truth: DanceTruth, rng: np.random.Generator) -> str:
    genre = GENRES[truth.genre]
    bpm = truth.bpm or 120
    tempo = "slow" if bpm < 100 else "moderate" if bpm < 125 else "fast"
    pace = _pick(rng, _TEMPO[tempo])
    who, music = _pick(rng, _WHO), _pick(rng, genre.words)
    style, arms = _pick(rng, _STYLES[genre.style]), _pick(rng, genre.moves)
    return _pick(
        rng,
        (
            f"{who} {style} to {music}, {arms}",
            f"{who} dances to {music} at {bpm} beats per minute, {arms}",
            f"{who} {style} to a {pace}beat of {bpm} bpm, {arms}",
            f"{who} dances to {music} and {style}",
        ),
    )


def _pick(rng: np.random.Generator, options: tuple[str, ...]) -> str:
    return options[int(rng.integers(len(options)))]
