"""Before a stage reads shards: each is compared with its sha256, once as long as the file does not change.

What has been compared is noted in `.compared.json` of the run folder, so the next stage, and the same command
after a kill, only looks whether the files are as they were. The first process of each machine compares, since
another machine may have a copy of its own; machines that see one file (the same path, inode and times) divide
the work.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from motionloom.datasets.base.pool import usable_cores
from motionloom.datasets.base.progress import Meter
from motionloom.datasets.shards.checksums import LocalShard, problems
from motionloom.pipeline.contract.stage import StageContext
from motionloom.pipeline.launch.process import JointError, local_rank
from motionloom.pipeline.launch.team import Team
from motionloom.pipeline.store.artifact import NOTE, Compared
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
    known = Compared(files={}) if again else Compared.read(record)
    todo = [
        (shard, state)
        for shard in shards
        if local_rank() == 0 and not known.knows(str(shard.path), shard.info.sha256, state := shard.state())
    ]
    # Every process knows who is to compare which file, and takes its turn at those that several see.
    seen = defaultdict[tuple[object, ...], list[int]](list)
    for rank, files in enumerate(team.gather([(str(shard.path), *state) for shard, state in todo])):
        for file in files:
            seen[file].append(rank)
    turns = {file: ranks[at % len(ranks)] for at, (file, ranks) in enumerate(seen.items())}
    mine = [shard for shard, state in todo if turns[str(shard.path), *state] == team.rank]
    mistakes: list[str] = []
    if mine:
        with Meter("comparing shards", len(mine), console=console) as meter:
            mistakes = problems(mine, min(_THREADS, usable_cores()), meter.advance)
    # Gathered, so that every process refuses, and none waits for one that has.
    wrong = [message for own in team.gather(mistakes) for message in own]
    if wrong:
        more = f" ({len(wrong)} such shards; motionloom data check lists them)" if len(wrong) > 1 else ""
        raise JointError(f"{wrong[0]}{more}")
    if todo:
        Compared.add(record, {str(shard.path): (shard.info.sha256, state) for shard, state in todo})
    return sum(shard.info.bytes for shard in mine)
