"""What editing adds: a command, what models can do, a part of the server's page, and a stage kind."""

from __future__ import annotations

from motionloom.datasets.base.register import declare

_FOLDER = "motionloom.pipeline.editing"

declare("command", {"edit": f"{_FOLDER}.command"})
declare("ability", {"edit": f"{_FOLDER}.edit"})
declare("part of the server", {"edit": f"{_FOLDER}.served"})
declare("stage kind", {"inbetween": f"{_FOLDER}.stage"})
