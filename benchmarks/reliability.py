"""Measure what a training survives: kills at random moments, and preemption on SLURM.

    python benchmarks/reliability.py WORK [--parts kills,preemption,...] [--kills 20] [--cells '*-1-0']

Every part leaves what it has seen as JSON in WORK; started again, the command does what is missing, then
prints all of it as tables. A SLURM of two nodes needs root and slurm-wlm; without
them that part says so and is left out. The trainings are those of
`benchmarks/reliability/*.yaml`: 60 steps each, a checkpoint every third.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "tests/helpers"))  # the tests do the same on a smaller scale

from bench import arguments, command_line  # noqa: E402
from kill_matrix import Cell, Seen, read_seen, run_cells  # noqa: E402
from preempted import launch, preempt, write_recipe  # noqa: E402
from slurm_cluster import Cluster, why_not  # noqa: E402

RECIPES = ROOT / "benchmarks/reliability"
FAMILIES = {
    "tokenizer": ("humantomato", "tokenizer (H2VQ, codebooks that reset)"),
    "tma": ("humantomato", "TMA (contrastive, latent draws)"),
    "gpt": ("humantomato", "GPT"),
    "face_diffusion": ("humantomato", "MDM"),
    "utt": ("ude", "UTT and its critic (two optimizers)"),
    "dmd": ("ude", "DMD"),
}
"""Stage: (recipe, what it stands for)."""

PREEMPTIONS = 5


def base_run(recipe: str, work: Path) -> Path:
    """A finished run of a recipe; the stage under test is taken out of copies of it."""
    run = work / f"base-{recipe}"
    work.mkdir(parents=True, exist_ok=True)
    words = [sys.executable, "-P", "-m", "motionloom", "run"]
    with (work / f"base-{recipe}.log").open("a") as log:
        words += [str(RECIPES / f"{recipe}.yaml"), "--out", str(run)]
        subprocess.run(words, check=True, stdout=log, stderr=log)
    return run


def kills(work: Path, args: argparse.Namespace) -> None:
    """SIGKILL at random moments: every family of trainings, loader workers 0 and 2, ranks 1 and 2."""
    folder = work / "kills"
    bases = {recipe: base_run(recipe, folder) for recipe, _ in FAMILIES.values()}
    cells = [
        Cell(
            name=f"{stage}-{ranks}-{workers}",
            recipe=str(RECIPES / f"{recipe}.yaml"),
            base=str(bases[recipe]),
            stage=stage,
            ranks=ranks,
            workers=workers,
            kills=args.kills,
        )
        for workers in (0, 2)
        for ranks in (1, 2)
        for stage, (recipe, _) in FAMILIES.items()
    ]
    run_cells([cell for cell in cells if fnmatch(cell.name, args.cells)], folder)


def kills_table(work: Path) -> list[str]:
    """All cells that are done, and their sums."""
    rows = [
        "| training | 1 rank | 2 ranks | 1 rank, 2 workers | 2 ranks, 2 workers each |",
        "|---|---|---|---|---|",
    ]
    cells: list[Seen] = []
    for stage, (_, words) in FAMILIES.items():
        row = [words]
        for ranks, workers in ((1, 0), (2, 0), (1, 2), (2, 2)):
            path = work / "kills" / f"{stage}-{ranks}-{workers}.json"
            if not path.exists():
                row.append("not run")
                continue
            seen = read_seen(path)
            cells.append(seen)
            row.append(
                f"{seen.kills} ({seen.in_a_write}), {seen.repeated}" + ("" if seen.exact else " DIFFERS")
            )
        rows.append(f"| {' | '.join(row)} |")
    wrong = [
        sum(getattr(seen, name) for seen in cells) for name in ("wrong_samples", "wrong_losses", "missing")
    ]
    trained = sum(seen.ranks * (seen.steps + seen.repeated) for seen in cells)
    unequal = sum(len(seen.unequal) for seen in cells)
    return [
        *rows,
        "",
        f"{sum(seen.kills for seen in cells)} kills, {sum(seen.in_a_write for seen in cells)} of them into a "
        f"half-written checkpoint. Of {trained:,} steps {wrong[0]} had other samples and {wrong[1]} other "
        f"losses; {wrong[2]} steps are missing; {unequal} files differ.",
    ]


def preemption(work: Path, args: argparse.Namespace) -> None:
    """Five urgent jobs on a SLURM of two nodes."""
    out = work / "preemption.json"
    if out.exists():
        return
    if why_not():
        print(f"preemption: {why_not()}", file=sys.stderr)
        return
    work.mkdir(parents=True, exist_ok=True)
    after = range(5, 5 + 45 * PREEMPTIONS, 45)
    with tempfile.TemporaryDirectory(dir=work) as folder, Cluster() as cluster:
        os.environ.update(cluster.environment)
        recipe = write_recipe(Path(folder), 45 * PREEMPTIONS + 30)
        calm = launch(cluster, recipe, Path(folder) / "calm")
        calm.wait_for_end(600)
        seen = preempt(calm, recipe, Path(folder) / "preempted", after)
    out.write_text(json.dumps(dataclasses.asdict(seen)))


def preemption_table(work: Path) -> list[str]:
    """A row for each preemption."""
    if not (work / "preemption.json").exists():
        return ["not run"]
    seen = json.loads((work / "preemption.json").read_text())
    rows = ["| preemption | last step before | first step after |", "|---|---|---|"]
    for number, one in enumerate(seen["restarts"], 1):
        rows.append(f"| {number} | {' | '.join(str(value) for value in one.values())} |")
    equal = "equal" if not seen["unequal"] else f"differ: {seen['unequal']}"
    rows += [
        "",
        f"{seen['steps']} steps, {seen['repeated']} trained twice, {seen['wrong_samples']} with another "
        f"sample, {seen['wrong_losses']} with another loss; files {equal}.",
    ]
    return rows


Part = tuple[Callable[[Path, argparse.Namespace], None], Callable[[Path], list[str]]]
PARTS: dict[str, Part] = {"preemption": (preemption, preemption_table), "kills": (kills, kills_table)}
"""Name -> what does it, and what prints it."""


def main() -> None:
    """Do what is asked and missing, then print everything."""
    parser = command_line(__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--parts", default=",".join(PARTS), help=f"of {', '.join(PARTS)}, or none")
    parser.add_argument("--kills", type=int, default=20, help="SIGKILLs in each cell of the matrix")
    parser.add_argument("--cells", default="*", help="pattern of the cells' names: STAGE-RANKS-WORKERS")
    args = arguments(parser)
    for name in filter(None, args.parts.split(",")):
        PARTS[name][0](args.work, args)
    for name, (_, table) in PARTS.items():
        print(f"\n{name}\n\n" + "\n".join(table(args.work)))


if __name__ == "__main__":
    main()
