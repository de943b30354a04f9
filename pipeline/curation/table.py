"""The commands of this folder and its reader of captions: which module registers each."""

from __future__ import annotations

from motionloom.datasets.base.register import declare

_HERE = "motionloom.pipeline.curation"

declare(
    "command",
    {
        "search": f"{_HERE}.search_command",
        "caption": f"{_HERE}.caption_command",
        "data add": f"{_HERE}.add_command",
        "data clean": f"{_HERE}.clean_command",
    },
)
declare("reader of captions", {"english": f"{_HERE}.requests"})
