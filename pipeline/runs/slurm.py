"""`motionloom launch`: a recipe on SLURM, one batch script a group, each waiting for those it reads from.

- `--dependency=afterok` with `--kill-on-invalid-dep`: a group starts when those before have succeeded, and
  is cancelled when that can no longer happen. A job that is queued again keeps its id, so what waits for it
  goes on waiting.
- A conversion in parts is an array of jobs, and the group behind it joins them: a part that is queued again,
  or given again with all of them, keeps the shards that it has finished.
- Preemption and broken nodes queue a job again (`--requeue`). A time limit would not: the batch script is
  warned before it, passes the warning on, and queues itself again once the command has ended. A training
  saves the step that it is at, so none is made twice. A node that breaks costs at most
  `train.checkpoint_every` steps.
"""

from __future__ import annotations

import os
import secrets
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import write_text
from motionloom.datasets.base.progress import duration
from motionloom.pipeline.launch.console import say
from motionloom.pipeline.launch.process import SAVED
from motionloom.pipeline.runs.dry_run import (
    explain_replacements,
    replaced_stages,
    say_estimate,
    training_times,
)
from motionloom.pipeline.runs.launch_plan import (
    WARN_SECONDS,
    Group,
    LaunchPlan,
    SlurmOptions,
    make_launch_plan,
)
from motionloom.pipeline.runs.plan import PlannedStage, doubts, make_plan
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.store.files import require_folder
from motionloom.pipeline.store.run_folder import require_own

LOG_FOLDER = ".slurm"
"""Inside the run folder: scripts and logs of the jobs. May be deleted when all is over."""

PROGRAM = (sys.executable, "-P", "-m", "motionloom")
"""By this Python, which must lie under the same path on every node."""

RECIPE_FILE = "recipe.yaml"
"""The resolved recipe of a launch, next to its scripts."""

_SIGNALS = """\
child= warned= came= early=
pass_on() {{  # to the command: a training saves the step it is at, and ends
  came=1
  if [ -n "$child" ]; then kill -s "$1" "$child" 2> /dev/null || true; else early=$1; fi
}}
warn() {{
  came=1
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
code=0
wait "$child" || code=$?
while [ -n "$came" ]; do  # a signal ended the wait, not the command
  came=
  ended=0
  wait "$child" || ended=$?
  [ "$ended" -eq 127 ] || code=$ended
done
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

    def submit(self, ids: Mapping[str, str]) -> list[str]:
        """The command that submits it behind the groups it waits for, whose jobs are `ids`."""
        after = [ids[name] for name in self.group.after]
        waiting = [f"--dependency=afterok:{':'.join(after)}"] if after else []
        return ["sbatch", "--parsable", *waiting, str(self.path)]


def launch_recipe(
    recipe: str | Path,
    *,
    nodes: int = 1,
    gpus_per_node: int = 8,
    out: Path | None = None,
    overrides: Sequence[str] = (),
    go_on: Sequence[str] = (),
    options: Sequence[str] = (),
    dry_run: bool = False,
    console: Console,
) -> LaunchPlan:
    """Submit a recipe to SLURM; with `dry_run` the plan and the scripts are printed and nothing is written.

    `options` are `KEY=VALUE` words of `SlurmOptions`.
    """
    loaded, slurm = load_recipe(recipe, overrides), SlurmOptions.from_words(options)
    run = Path(os.path.abspath(out or Path("runs") / loaded.name))  # noqa: PTH100 - links stay as they are
    require_folder(run)
    for what, place in (("--out", run), ("the current folder", Path.cwd())):
        if not str(place).isprintable():  # a batch script must not get another line
            raise UserError(f"{what} {str(place)!r}: has characters that are not printable; choose another")
    rows: list[PlannedStage] = []
    try:
        rows = make_plan(loaded, run, go_on=go_on)
    except UserError as error:
        if not dry_run or (run / "recipe.yaml").is_file():
            raise
        # The data may be on another machine.
        say(console, f"time and disk not estimated: {error}")
    if (refusal := explain_replacements(run, loaded.name, replaced_stages(run, rows))) is not None:
        raise UserError(refusal)
    plan = make_launch_plan(loaded, slurm, out=run, nodes=nodes, gpus_per_node=gpus_per_node, go_on=go_on)
    for line in plan.lines(slurm):
        say(console, line)
    planned = [row for row in rows if row.action in {"run", "resume"}]
    for doubt in doubts(loaded, run, (row.stage for row in planned)):
        say(console, doubt, "yellow")
    _require_time(plan, slurm, training_times(run, planned))
    if dry_run:
        say_estimate(loaded, console, run, planned)
        _show_scripts(plan, slurm, console)
    else:
        submit_run(plan, slurm, console)
    return plan


def _require_time(plan: LaunchPlan, options: SlurmOptions, times: Mapping[str, float]) -> None:
    """Refuse a time limit within which, with all its tries, a group's trainings cannot end."""
    for group in plan.groups:
        needed = sum(times[name] for name in group.stages if name in times)
        if needed > 60 * options.time_minutes * (options.requeues + 1):
            raise UserError(
                f"group {group.name} takes about {duration(needed)} and has {options.time_minutes} minutes "
                f"{options.requeues + 1} times; raise --cluster time_minutes or requeues"
            )


def _show_scripts(plan: LaunchPlan, options: SlurmOptions, console: Console) -> None:
    folder = Path(plan.out) / LOG_FOLDER / "DATE-TIME"
    say(console, f"would write {folder / RECIPE_FILE}: the resolved recipe")
    ids = {group.name: f"ID-OF-{group.name}" for group in plan.groups}
    for script in slurm_scripts(plan, options, folder, Path.cwd()):
        console.print(f"\n{script.path}:\n{script.text}", soft_wrap=True, markup=False)
        say(console, " ".join(script.submit(ids)))


def slurm_scripts(plan: LaunchPlan, options: SlurmOptions, folder: Path, cwd: Path) -> list[Script]:
    """The batch scripts of a plan, to be written into `folder`; jobs run in `cwd`."""
    return [
        Script(group, folder / f"{group.name}.sbatch", _text(plan, group, options, folder, cwd))
        for group in plan.groups
    ]


def submit_run(plan: LaunchPlan, options: SlurmOptions, console: Console) -> list[str]:
    """Write the scripts into the run folder and submit them; the job ids."""
    if shutil.which("sbatch") is None:
        raise UserError("no sbatch here: start this where jobs are submitted, or look with --dry-run")
    require_own(Path(plan.out))
    # A folder of its own for every submission.
    folder = Path(plan.out) / LOG_FOLDER / f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(2)}"
    folder.mkdir(parents=True)
    write_text(folder / RECIPE_FILE, plan.recipe.to_yaml())
    scripts = slurm_scripts(plan, options, folder, Path.cwd())
    for script in scripts:
        write_text(script.path, script.text)
    ids: dict[str, str] = {}
    for script in scripts:
        submitted = subprocess.run(script.submit(ids), capture_output=True, text=True)
        if submitted.returncode != 0:
            if ids:
                subprocess.run(["scancel", *ids.values()], capture_output=True)
            raise UserError(f"sbatch refused {script.path}: {submitted.stderr.strip()}")
        ids[script.group.name] = submitted.stdout.strip().partition(";")[0]
        before = ", ".join(ids[name] for name in script.group.after)
        say(console, f"{script.group.name}: job {ids[script.group.name]}{before and f', after {before}'}")
    jobs = list(ids.values())
    say(console, f"watch: squeue --jobs {','.join(jobs)}; stop: scancel {' '.join(jobs)}; logs: {folder}")
    return jobs


def _text(plan: LaunchPlan, group: Group, options: SlurmOptions, folder: Path, cwd: Path) -> str:
    lines = ["#!/bin/bash", *(_directive(*one) for one in _options(plan, group, options, folder, cwd))]
    lines += [_SIGNALS.format(requeues=options.requeues).rstrip()]
    part = f' --set hardware.part="$SLURM_ARRAY_TASK_ID/{group.parts}"' if group.parts > 1 else ""
    lines += [f"{shlex.join(_command(plan, group, options, folder))}{part} &"]
    lines += [_WAIT.format(saved=SAVED).rstrip()]
    return "\n".join(lines) + "\n"


def _options(
    plan: LaunchPlan, group: Group, options: SlurmOptions, folder: Path, cwd: Path
) -> list[tuple[str, str | None]]:
    machines = group.machines
    partition = options.partition if machines.gpus else options.light_partition or options.partition
    array = f"1-{group.parts}" if group.parts > 1 else None
    log = f"{str(folder / group.name).replace('%', '%%')}-{'%A_%a' if array else '%j'}.log"
    options_of_job: list[tuple[str, str | None]] = [
        ("job-name", plan.job(group)),
        ("array", array),
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


def _command(plan: LaunchPlan, group: Group, options: SlurmOptions, folder: Path) -> Sequence[str]:
    command, machines = plan.command(group, str(folder / RECIPE_FILE), PROGRAM), group.machines
    if machines.nodes * machines.processes == 1:
        return command
    task_options = [f"--nodes={machines.nodes}", f"--ntasks-per-node={machines.processes}"]
    task_options += [f"--cpus-per-task={options.cpus}"]
    if machines.gpus:
        # All GPUs of a node for each of its processes, which choose theirs.
        task_options.append(f"--gpus-per-node={machines.gpus}")
    return ["srun", *task_options, "--kill-on-bad-exit=1", *command]
