"""One stage, by all processes that take part in its kind."""

from __future__ import annotations

from motionloom.models.training.distributed import alone
from motionloom.pipeline.contract.stage import StageContext, StageKind
from motionloom.pipeline.launch.team import Team
from motionloom.pipeline.launch.watch import current


def perform(kind: StageKind, context: StageContext, team: Team) -> None:
    """One stage, by all processes that take part in its kind."""
    watch = current()
    if watch is not None:
        watch.enter_stage(context.name, context.folder, "before its first step")
    if kind.trains:
        team.meet()
        kind.run(context)
        return
    with alone():
        if kind.shares:
            team.meet()
            kind.share(context)
            team.meet()
        if team.leads:
            kind.run(context)
