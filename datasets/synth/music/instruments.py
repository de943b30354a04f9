"""The sounds of real instruments: FluidSynth with a General MIDI sound font.

Needs `pip install 'motionloom[band]'`, the library FluidSynth and a sound font: the file that
`MOTIONLOOM_SOUND_FONT` names, or FluidR3 (MIT licence; Debian's `fluid-soundfont-gm`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.schema import UserError

SOUND_FONT = Path("/usr/share/sounds/sf2/FluidR3_GM.sf2")
DRUMS = 9
"""The channel of drums."""
_DRUM_BANK = 128

Stroke = tuple[float, int, Callable[[], object]]
"""When in seconds, what comes first of what is at one time (the lower), and what is done."""


class Instruments:
    """Sixteen players, dry and at the rate of the samples."""

    def __init__(self, rate: int) -> None:
        try:
            import fluidsynth
        except ImportError as error:  # the binding, or the library that it binds
            raise UserError(
                f"songs of `music: played` need FluidSynth ({error}); pip install 'motionloom[band]' and the "
                f"library (Debian: apt install libfluidsynth3)"
            ) from None
        font = sound_font()
        dry = {"synth.reverb.active": 0, "synth.chorus.active": 0}
        self.rate = rate
        self.synth: Any = fluidsynth.Synth(gain=0.5, samplerate=rate, channels=16, **dry)
        self._font = self.synth.sfload(str(font))

    def select(self, channel: int, program: int) -> None:
        """Give a channel the instrument of a General MIDI number from 0; that of drums a kit."""
        self.synth.program_select(channel, self._font, _DRUM_BANK if channel == DRUMS else 0, program)

    def play(self, strokes: Iterable[Stroke], seconds: float) -> NDArray[np.float32]:
        """Strokes in any order -> dry mono samples [seconds * rate], loudest 1. The players then go home."""
        total = round(seconds * self.rate)
        timed = sorted(
            ((round(at * self.rate), first, do) for at, first, do in strokes), key=lambda one: one[:2]
        )
        blocks, now = [], 0
        for at, _, do in timed:
            if at >= total:
                break
            if at > now:
                blocks.append(self.synth.get_samples(at - now))
                now = at
            do()
        if now < total:
            blocks.append(self.synth.get_samples(total - now))
        self.synth.delete()
        sound = np.concatenate(blocks).reshape(-1, 2).mean(axis=1)
        return np.asarray(sound / max(1.0, float(np.abs(sound).max())), dtype=np.float32)


def sound_font() -> Path:
    """The file; `UserError` where there is none."""
    path = Path(os.environ.get("MOTIONLOOM_SOUND_FONT", SOUND_FONT))
    if not path.is_file():
        raise UserError(
            f"{path}: no such sound font, which songs of `music: played` need; install one (Debian: "
            f"apt install fluid-soundfont-gm libfluidsynth3) or name it in MOTIONLOOM_SOUND_FONT"
        )
    return path
