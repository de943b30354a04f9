"""`motionloom launch`: a recipe on SLURM, one batch script a group, each waiting for those it reads from.

- `--dependency=afterok` with `--kill-on-invalid-dep`: a group starts when those before have succeeded, and
  is cancelled when that can no longer happen. A job that is queued again keeps its id, so what waits for it
  goes on waiting.
- A conversion in parts is an array of jobs, or several where the cluster's arrays are smaller, and the group
  behind it joins them: a part that is queued again keeps the shards that it has finished, and another launch
  submits those parts alone that are missing.
- A sweep is an array a group, with a run folder for each row; a row waits for itself alone (`aftercorr`).
- Preemption and broken nodes queue a job again (`--requeue`). A time limit would not: the batch script is
  warned before it, passes the warning on, and queues itself again once the command has ended. A training
  saves the step that it is at, so none is made twice. A node that breaks costs at most
  `train.checkpoint_every` steps.
"""

from __future__ import annotations

import re
import secrets
import shlex
import shutil
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import write_text
from motionloom.datasets.base.progress import duration
from motionloom.datasets.shards.finish import missing_parts
from motionloom.pipeline.launch.cluster import WARN_SECONDS, ClusterOptions
from motionloom.pipeline.launch.console import say
from motionloom.pipeline.launch.process import SAVED
from motionloom.pipeline.runs.cluster.launch_plan import Group, LaunchPlan
from motionloom.pipeline.runs.dry_run import (
    explain_replacements,
    replaced_stages,
    say_estimate,
    training_times,
)
from motionloom.pipeline.runs.plan import PlannedStage, doubts, make_plan
from motionloom.pipeline.store.data import SHARDS
from motionloom.pipeline.store.files import require_folder
from motionloom.pipeline.store.run_folder import require_own, stage_folder

LOG_FOLDER = ".slurm"
"""Inside the run folder: scripts and logs of the jobs. May be deleted when all is over."""

PROGRAM = (sys.executable, "-P", "-m", "motionloom")
"""By this Python, which must lie under the same path on every node."""

_SIGNALS = """\
child= warned= early=
pass_on() {{  # to the command: a training saves the step it is at, and ends
  if [ -n "$child" ]; then kill -s "$1" "$child" 2> /dev/null || true; else early=$1; fi
}}
warn() {{
  [ "${{SLURM_RESTART_COUNT:-0}}" -lt {requeues} ] || return 0  # it may still finish
  warned=1
  pass_on USR1
}}
trap warn USR1
trap 'pass_on TERM' TERM
"""
"""SLURM warns the script with USR1, and ends all with TERM: a preemption, a time limit or a scancel.

A preemption with a grace time begins with TERM to what srun has started. Once that has saved and ended, the
job would be over, and failed, before SLURM queues it again: the script does so itself.
"""

_WAIT = """\
child=$!
[ -z "$early" ] || pass_on "$early"
# Not by `wait`: bash loses the code of what ends while a signal interrupts it. A signal waits for `sleep`.
while kill -0 "$child" 2> /dev/null; do
  sleep 1
done
code=0
wait "$child" || code=$?
# {saved}: a training is saved. 138: the warning ended a command that has nothing to save.
# A job that was cancelled is not RUNNING any more; queued again it would come back.
again=
job=$SLURM_JOB_ID
[ -z "${{SLURM_ARRAY_TASK_ID:-}}" ] || job=${{SLURM_ARRAY_JOB_ID}}_$SLURM_ARRAY_TASK_ID  # not the whole array
state=$(squeue --noheader --jobs="$job" --format=%T 2> /dev/null) || state=
if [ -n "$warned" ] && [ "${{state:-RUNNING}}" = RUNNING ]; then
  if [ "$code" -eq {saved} ] || [ "$code" -eq 138 ]; then again="the time limit is near"; fi
elif [ "$code" -eq {saved} ] && [ "$state" = RUNNING ]; then
  again="asked to end"  # the grace time of a preemption
fi
if [ -n "$again" ] && scontrol requeue "$job"; then
  echo "$again: queued again, goes on from there"
  trap - TERM
  sleep 3600  # SLURM ends this try
fi
exit "$code"
"""


@dataclass(frozen=True)
class Script:
    """A group as sbatch takes it."""

    group: Group
    path: Path
    text: str
    row_by_row: bool = False
    """Whether each job of an array waits for the one of its number alone."""

    def submit(self, ids: Mapping[str, Sequence[str]]) -> list[str]:
        """The command that submits it behind the groups it waits for, whose jobs are `ids`."""
        after = [job for name in self.group.after for job in ids.get(name, ())]
        how = "aftercorr" if self.row_by_row else "afterok"
        waiting = [f"--dependency={how}:{':'.join(after)}"] if after else []
        return ["sbatch", "--parsable", *waiting, str(self.path)]


def launch_on_slurm(
    plans: Sequence[LaunchPlan], out: Path, options: ClusterOptions, *, dry_run: bool, console: Console
) -> None:
    """Submit a recipe, or the rows of a sweep whose folders are in `out`; with `dry_run` only print it."""
    for what, place in (("--out", out), ("the current folder", Path.cwd())):
        if not str(place).isprintable():  # a batch script must not get another line
            raise UserError(f"{what} {str(place)!r}: has characters that are not printable; choose another")
    planned = [_planned(plan, options, dry_run, console) for plan in plans]
    if dry_run:
        say_estimate(plans[0].recipe, console, Path(plans[0].out), planned[0])
    if len(plans) == 1:
        plans = [_what_is_missing(plans[0], planned[0])]
    submit_run(plans, out, options, console, dry_run=dry_run)


def _planned(
    plan: LaunchPlan, options: ClusterOptions, dry_run: bool, console: Console
) -> list[PlannedStage]:
    """What is to be made in a run folder; refuses what its run would refuse, and time limits too short."""
    run = Path(plan.out)
    rows = list[PlannedStage]()
    require_folder(run)
    try:
        rows = make_plan(plan.recipe, run, go_on=plan.go_on)
    except UserError as error:
        if not dry_run or (run / "recipe.yaml").is_file():
            raise
        # The data may be on another machine.
        say(console, f"time and disk not estimated: {error}")
    if (refusal := explain_replacements(run, plan.recipe.name, replaced_stages(run, rows))) is not None:
        raise UserError(refusal)
    planned = [row for row in rows if row.action in {"run", "resume"}]
    for doubt in doubts(plan.recipe, run, (row.stage for row in planned)):
        say(console, doubt, "yellow")
    _require_time(plan, options, training_times(run, planned))
    return planned


def _what_is_missing(plan: LaunchPlan, planned: Sequence[PlannedStage]) -> LaunchPlan:
    """The plan with those parts alone that an earlier launch has not finished."""
    begun = {row.stage.name for row in planned if row.action == "resume"}
    run = Path(plan.out)
    groups = list[Group]()
    for group in plan.groups:
        if group.parts > 1 and begun.issuperset(group.stages):
            left = [missing_parts(stage_folder(run, name) / SHARDS, group.parts) for name in group.stages]
            group = replace(group, left=tuple(sorted(set().union(*left))))
        groups.append(group)
    return replace(plan, groups=tuple(groups))


def _require_time(plan: LaunchPlan, options: ClusterOptions, times: Mapping[str, float]) -> None:
    """Refuse a time limit within which, with all its tries, a group's trainings cannot end."""
    for group in plan.groups:
        needed = sum(times[name] for name in group.stages if name in times)
        if needed > 60 * options.time_minutes * (options.requeues + 1):
            raise UserError(
                f"group {group.name} takes about {duration(needed)} and has {options.time_minutes} minutes "
                f"{options.requeues + 1} times; raise --cluster time_minutes or requeues"
            )


def recipe_files(plans: Sequence[LaunchPlan]) -> list[str]:
    """Names of the files of the resolved recipes, next to the scripts: one for each row of a sweep."""
    return [f"recipe-{row + 1}.yaml" for row in range(len(plans))] if len(plans) > 1 else ["recipe.yaml"]


def slurm_scripts(
    plans: Sequence[LaunchPlan], options: ClusterOptions, folder: Path, cwd: Path
) -> list[Script]:
    """The batch scripts of a plan, or of the rows of a sweep; to be written into `folder`, run in `cwd`.

    An array of more parts than the cluster allows is several, each of which counts from 1.
    """
    rows = len(plans)
    most = _most_jobs()
    if rows > most:
        raise UserError(f"--sweep has {rows} rows and an array of this cluster at most {most}; launch fewer")
    scripts = []
    for group in plans[0].groups:
        jobs = range(1, group.parts + 1) if group.left is None else group.left
        for start in range(0, group.parts, most):
            array: Sequence[int] = [job - start for job in jobs if 0 < job - start <= most]
            if array:
                name = f"{group.name}{f'-from-{start + 1}' * (start > 0)}"
                if group.parts == 1:
                    array = range(1, rows + 1) if rows > 1 else ()
                every = array and array[-1] - array[0] == len(array) - 1
                numbers = f"{array[0]}-{array[-1]}" if every else ",".join(map(str, array))
                text = _text(plans, group, options, folder, cwd, numbers, start)
                scripts.append(Script(group, folder / f"{name}.sbatch", text, rows > 1))
    return scripts


def _most_jobs() -> int:
    """Jobs of one array: SLURM's MaxArraySize is one more than the largest index, and 1001 by default."""
    try:
        shown = subprocess.run(["scontrol", "show", "config"], capture_output=True, text=True).stdout
    except OSError:
        shown = ""
    found = re.search(r"MaxArraySize\s*=\s*(\d+)", shown)
    return max(1, int(found[1] if found else 1001) - 1)


def submit_run(
    plans: Sequence[LaunchPlan],
    out: Path,
    options: ClusterOptions,
    console: Console,
    *,
    dry_run: bool = False,
) -> list[str]:
    """Write the scripts into the run folder and submit them, or only print them; the job ids."""
    # A folder of its own for every submission.
    now = "DATE-TIME" if dry_run else f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(2)}"
    folder = out / LOG_FOLDER / now
    scripts = slurm_scripts(plans, options, folder, Path.cwd())
    recipes = dict(zip(recipe_files(plans), plans, strict=True))
    if dry_run:
        for name in recipes:
            say(console, f"would write {folder / name}: the resolved recipe")
    else:
        if shutil.which("sbatch") is None:
            raise UserError("no sbatch here: start this where jobs are submitted, or look with --dry-run")
        require_own(out)
        folder.mkdir(parents=True)
        for name, plan in recipes.items():
            write_text(folder / name, plan.recipe.to_yaml())
        for script in scripts:
            write_text(script.path, script.text)
    jobs: list[str] = []
    ids = defaultdict[str, list[str]](list)  # by group, which may be several arrays
    for script in scripts:
        command = script.submit(ids)
        if dry_run:
            console.print(f"\n{script.path}:\n{script.text}", soft_wrap=True, markup=False)
            say(console, " ".join(command))
            job = f"ID-OF-{script.path.stem}"
        else:
            job = _submit(command, jobs)
            before = ", ".join(job for one in script.group.after for job in ids[one])
            say(console, f"{script.group.name}: job {job}{before and f', after {before}'}")
        jobs.append(job)
        ids[script.group.name].append(job)
    if not dry_run:
        say(console, f"watch: squeue --jobs {','.join(jobs)}; stop: scancel {' '.join(jobs)}; logs: {folder}")
    return jobs


def _submit(command: Sequence[str], jobs: Sequence[str]) -> str:
    """The id of a new job; where SLURM refuses it, it takes `jobs` with it."""
    submitted = subprocess.run(command, capture_output=True, text=True)
    if submitted.returncode == 0:
        return submitted.stdout.strip().partition(";")[0]
    if jobs:
        subprocess.run(["scancel", *jobs], capture_output=True)
    raise UserError(f"sbatch refused {command[-1]}: {submitted.stderr.strip()}")


def _text(
    plans: Sequence[LaunchPlan],
    group: Group,
    options: ClusterOptions,
    folder: Path,
    cwd: Path,
    array: str,
    start: int,
) -> str:
    asked = _options(plans[0], group, options, folder, cwd, array)
    lines = ["#!/bin/bash", *(_directive(*one) for one in asked)]
    lines += [_SIGNALS.format(requeues=options.requeues).rstrip()]
    commands = [
        shlex.join(_command(plan, group, options, folder / name))
        for name, plan in zip(recipe_files(plans), plans, strict=True)
    ]
    number = f"$((SLURM_ARRAY_TASK_ID + {start}))" if start else "$SLURM_ARRAY_TASK_ID"
    part = f' --set hardware.part="{number}/{group.parts}"' if group.parts > 1 else ""
    if len(plans) > 1:
        rows = [f"{row}) {command} & ;;" for row, command in enumerate(commands, start=1)]
        lines += ["case $SLURM_ARRAY_TASK_ID in  # the row of the sweep", *rows, "esac"]
    else:
        lines += [f"{commands[0]}{part} &"]
    lines += [_WAIT.format(saved=SAVED).rstrip()]
    return "\n".join(lines) + "\n"


def _options(
    plan: LaunchPlan, group: Group, options: ClusterOptions, folder: Path, cwd: Path, array: str
) -> list[tuple[str, str | None]]:
    machines = group.machines
    partition = options.partition if machines.gpus else options.light_partition or options.partition
    log = f"{str(folder / group.name).replace('%', '%%')}-{'%A_%a' if array else '%j'}.log"
    options_of_job: list[tuple[str, str | None]] = [
        ("job-name", plan.job(group)),
        ("array", array or None),
        ("partition", partition),
        ("nodes", str(machines.nodes)),
        ("ntasks-per-node", str(machines.processes)),
        ("cpus-per-task", str(options.cpus)),
        ("gpus-per-node", str(machines.gpus) if machines.gpus else None),
        ("mem", f"{max(1, round(options.memory_gb * machines.processes * 1024))}M"),
        ("time", str(options.time_minutes)),
        ("chdir", str(cwd)),
        ("output", log),
        ("open-mode", "append"),
        ("signal", f"B:USR1@{WARN_SECONDS}"),
        ("kill-on-invalid-dep", "yes"),
        *options.extra.items(),
    ]
    return [("requeue", None), *((name, value) for name, value in options_of_job if value is not None)]


def _directive(name: str, value: str | None) -> str:
    """A line for sbatch, which splits it at blanks and knows quotes and backslashes, but is no shell."""
    if value is None:
        return f"#SBATCH --{name}"
    if not all(character.isalnum() or character in "-_./:,@%=+" for character in value):
        value = '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return f"#SBATCH --{name}={value}"


def _command(plan: LaunchPlan, group: Group, options: ClusterOptions, recipe: Path) -> Sequence[str]:
    command = plan.command(group, str(recipe), PROGRAM)
    machines = group.machines
    if machines.nodes * machines.processes == 1:
        return command
    task_options = [f"--nodes={machines.nodes}", f"--ntasks-per-node={machines.processes}"]
    task_options += [f"--cpus-per-task={options.cpus}"]
    if machines.gpus:
        # All GPUs of a node for each of its processes, which choose theirs.
        task_options.append(f"--gpus-per-node={machines.gpus}")
    return ["srun", *task_options, "--kill-on-bad-exit=1", *command]
