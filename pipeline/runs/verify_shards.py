"""Before a stage reads shards: each is compared with its sha256, once as long as the file does not change.

What has been compared is noted in `.compared.json` of the run folder, so the next stage, and the same command
after a kill, only looks whether the files are as they were. Processes that see the same files (those of one
machine, or all of them on a shared file system) compare a share each; a machine with a copy of its own
compares all of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from motionloom.datasets.base.progress import Meter
from motionloom.datasets.shards.checksums import LocalShard, problems
from motionloom.pipeline.contract.stage import StageContext
from motionloom.pipeline.launch.hardware import usable_cores
from motionloom.pipeline.launch.process import JointError
from motionloom.pipeline.launch.team import Team
from motionloom.pipeline.store.artifact import NOTE, Compared, ComparedFile, State
from motionloom.pipeline.store.data import Data

_THREADS = 4
"""At most, in a process: more read no disk faster."""


def verify_shards(context: StageContext, team: Team, run: Path) -> None:
    """Refuse shards among the stage's inputs that are not those of their manifest.

    Every process of `team` calls this; it returns when all are here, and an error is raised in all.
    """
    team.meet()  # before: the lead may still be making what is to be compared
    how = context.hardware.verify_shards
    shards: list[LocalShard] = []
    if how != "never" and context.again is None:
        for stage in context.inputs.values():
            if stage.gives("data") and not stage.exported:
                shards += Data(stage.folder).local_shards()
    if shards:
        each = list({shard.path: shard for shard in shards}.values())
        compare_shards(each, run / NOTE, team, context.console, again=how == "always")


def compare_shards(
    shards: Sequence[LocalShard], record: Path, team: Team, console: Console, *, again: bool = False
) -> int:
    """Compare what `record` does not know, with `again` all; how many bytes this process has read.

    Raises:
        JointError: A shard is not the manifest's; the first one is named.
    """
    states = [shard.state() for shard in shards]
    known = Compared.read(record) if team.leads and not again else Compared(files={})
    # The lead's note counts for all: another machine may see an older one.
    seen_by = team.gather((states, known.dump() if team.leads else None))
    known = Compared.parse(seen_by[0][1], str(record))
    todo: list[LocalShard] = []
    missing = 0
    # Processes that see the same states see the same files, and share them; another state is another copy.
    for seen in {str(seen): seen for seen, _ in seen_by}.values():
        alike = [rank for rank, (theirs, _) in enumerate(seen_by) if theirs == seen]
        pending = [
            shard
            for shard, state in zip(shards, seen, strict=True)
            if not known.knows(str(shard.path), shard.info.sha256, state)
        ]
        missing += len(pending)
        if team.rank in alike:
            todo = pending[alike.index(team.rank) :: len(alike)]
    if not missing:
        return 0
    size = sum(shard.info.bytes for shard in todo)
    with Meter("comparing shards", len(todo), console=console) as meter:
        mistakes = problems(todo, min(_THREADS, usable_cores()), meter.advance)
    # Gathered, so that every process refuses, and none waits for one that has.
    wrong = [message for own in team.gather(mistakes) for message in own]
    if wrong:
        more = f" ({len(wrong)} such shards; motionloom data check lists them)" if len(wrong) > 1 else ""
        raise JointError(f"{wrong[0]}{more}")
    if team.leads:
        # What the files of all machines are like now that they have been compared.
        compared = {}
        for place, shard in enumerate(shards):
            each: list[State] = list({str(seen[place]): seen[place] for seen, _ in seen_by}.values())
            compared[str(shard.path)] = ComparedFile(sha256=shard.info.sha256, states=each)
        Compared.add(record, compared)
    return size
