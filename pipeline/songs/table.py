"""What this folder adds: a player of songs, and the stage kinds that train the beat tracker on them."""

from __future__ import annotations

from motionloom.datasets.base.register import declare

_FOLDER = "motionloom.pipeline.songs"

declare("player of songs", {"played": f"{_FOLDER}.studio"})
declare("stage kind", {"songs": f"{_FOLDER}.songs", "beats": f"{_FOLDER}.stage"})
