"""How well beats are found in songs that are charted by hand (`charted.py`): ours and librosa's.

    python benchmarks/beats.py /usr/share/games/fretsonfire/data/songs funkin-rewritten/src/love/charts \\
        /usr/share/games/openttd/baseset/openmsx --weights before=beats-of-yesterday.safetensors

Of each place every second song is for choices (`chosen by`), the others are for figures. mir_eval counts, the
first five seconds left out: F within 70 ms; any octave, the best of half, whole and double tempo; CMLt and
AMLt, the share of beats that go on right, at the charted tempo or at any; and songs half a beat off, where at
least three of ten charted beats are answered midway.

Ceiling, of trackers whose weights may not be shipped: madmom (CC BY-NC-SA), F 1.00 on ten charted songs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import mir_eval.beat
import numpy as np
from bench import Column, Record, arguments, command_line, report
from charted import Times, charted

from motionloom.datasets.audio.beat_net import WEIGHTS, activations, band_power, levels, read_beat_net
from motionloom.datasets.audio.features import beats as librosa_beats
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.audio.tracker import decode

COLUMNS = (
    Column("songs", "songs", 0),
    Column("F", "f", 2),
    Column("any octave", "any", 2),
    Column("CMLt", "cmlt", 2),
    Column("AMLt", "amlt", 2),
    Column("half a beat off", "half", 0),
)
HALF = 0.3
"""F of beats midway from which a song is half a beat off, at least in part."""
Song = tuple[str, Sound, Times]


def between(times: Times) -> Times:
    return np.asarray((times[1:] + times[:-1]) / 2)


def figures(truth: Times, found: Times) -> dict[str, float]:
    """All figures of a song."""
    truth, found = (mir_eval.beat.trim_beats(times) for times in (truth, found))
    doubled = np.sort(np.concatenate([truth, between(truth)]))
    ways = (truth, between(truth), truth[::2], truth[1::2], doubled)
    f, half, *others = (mir_eval.beat.f_measure(way, found) for way in ways)
    _, cmlt, _, amlt = mir_eval.beat.continuity(truth, found)
    any_octave = max(f, *others)
    off = float(half >= HALF and any_octave < 0.8)
    return {"f": f, "any": any_octave, "cmlt": cmlt, "amlt": amlt, "half": off}


def tracked(weights: Path) -> Callable[[Sound], Times]:
    net = read_beat_net(weights)
    return lambda sound: decode(activations(net, levels(band_power(sound)))).times


def row(title: str, songs: list[Song], find: Callable[[Sound], Times]) -> Record:
    each = {name: figures(truth, find(sound)) for name, sound, truth in songs}
    cells = {
        figure: [float((np.sum if figure == "half" else np.mean)([one[figure] for one in each.values()]))]
        for figure in ("f", "any", "cmlt", "amlt", "half")
    }
    below = {name: f"{one['f']:.2f}" for name, one in each.items() if one["f"] < 0.8}
    return {"title": title, "cells": {"songs": [len(songs)]} | cells, "below .8": below}


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("places", nargs="+", type=Path)
    parser.add_argument("--weights", nargs="*", default=[], help="others, each as name=FILE.safetensors")
    args = arguments(parser)
    sets: dict[str, list[Song]] = {"charted": [], "rendered": []}
    for place in args.places:
        scored = any(file.name != "notes.mid" for file in place.glob("*.mid"))
        sets["rendered" if scored else "charted"] += charted(place)
    finders: Mapping[str, Callable[[Sound], Times]] = {
        **{one.partition("=")[0]: tracked(Path(one.partition("=")[2])) for one in args.weights},
        "ours": tracked(WEIGHTS),
        "librosa": lambda sound: librosa_beats(sound.samples, sound.rate),
    }
    rows = [
        row(f"{kind}, {use}, {name}", songs[first::2], find)
        for kind, songs in sets.items()
        for first, use in ((0, "chosen by"), (1, "figures"))
        for name, find in finders.items()
        if songs
    ]
    report("Beats of charted songs", COLUMNS, rows, args.record)


if __name__ == "__main__":
    main()
