"""One stage, by all processes that take part in its kind."""

from __future__ import annotations

from pathlib import Path

from motionloom.models.training.distributed import alone
from motionloom.pipeline.contract.stage import StageContext, StageKind
from motionloom.pipeline.launch.team import Team
from motionloom.pipeline.launch.watch import current
from motionloom.pipeline.runs.sound import require_sound_shards


def perform(kind: StageKind, context: StageContext, team: Team, run: Path) -> None:
    """One stage of `run`, by all processes that take part in its kind."""
    watch = current()
    if watch is not None:
        watch.enter_stage(context.name, context.folder, "before its first step")
    if kind.trains:
        require_sound_shards(context, team, run)
        kind.run(context)
        return
    with alone():
        if kind.shares:
            require_sound_shards(context, team, run)
            kind.share(context)
            team.meet()
        elif team.leads:
            require_sound_shards(context, Team(), run)
        if team.leads:
            kind.run(context)
