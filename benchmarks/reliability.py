"""What a training survives, measured: kills, preemption on SLURM, nodes that meet over a network, full disks, damage.

    python benchmarks/reliability.py WORK [--parts kills,preemption,...] [--kills 20]

Every part leaves what it has seen as JSON in WORK; started again, the command does what is missing, then
prints all of it as the tables of docs/reliability.md. Parts that this machine cannot do (SLURM, network
namespaces and a file system of its own need root) say why and are left out. The trainings are those of
`benchmarks/reliability/*.yaml`: 60 steps each, a checkpoint every third.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "tests/helpers"))  # the tests do the same on a smaller scale

from kill_matrix import Cell, read_seen, run_cells  # noqa: E402

RECIPES = ROOT / "benchmarks/reliability"
FAMILIES = {
    "tokenizer": ("humantomato", "tokenizer (H2VQ, codebooks that reset)"),
    "tma": ("humantomato", "TMA (contrastive, latent draws)"),
    "gpt": ("humantomato", "GPT"),
    "face_diffusion": ("humantomato", "diffusion"),
    "utt": ("ude", "UTT and its critic (two optimizers)"),
    "dmd": ("ude", "DMD"),
}
"""Stage: (recipe, what it stands for)."""


def base_run(recipe: str, work: Path) -> Path:
    """A finished run of a recipe; the stage under test is taken out of copies of it."""
    run = work / f"base-{recipe}"
    words = [sys.executable, "-P", "-m", "motionloom.pipeline.cli.main", "run"]
    with (work / f"base-{recipe}.log").open("a") as log:
        words += [str(RECIPES / f"{recipe}.yaml"), "--out", str(run)]
        subprocess.run(words, check=True, stdout=log, stderr=log)
    return run


def kills(work: Path, count: int) -> None:
    """SIGKILL at random moments: every family of trainings, loader workers 0 and 2, ranks 1 and 2."""
    folder = work / "kills"
    folder.mkdir(parents=True, exist_ok=True)
    bases = {recipe: base_run(recipe, folder) for recipe, _ in FAMILIES.values()}
    cells = [
        Cell(
            name=f"{stage}-{ranks}-{workers}",
            recipe=str(RECIPES / f"{recipe}.yaml"),
            base=str(bases[recipe]),
            stage=stage,
            ranks=ranks,
            workers=workers,
            kills=count,
        )
        for workers in (0, 2)
        for ranks in (1, 2)
        for stage, (recipe, _) in FAMILIES.items()
    ]
    run_cells(cells, folder)


def kills_table(work: Path) -> list[str]:
    """Rows of all cells that are done."""
    rows = [
        "| training | ranks | workers | kills | in a write | steps | trained twice | other samples | other losses | artifact |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for stage, (_, words) in FAMILIES.items():
        for path in sorted((work / "kills").glob(f"{stage}-?-?.json")):
            seen = read_seen(path)
            equal = "differs: " + ", ".join(seen.unequal) if seen.unequal else "equal"
            rows.append(
                f"| {words} | {seen.ranks} | {seen.workers} | {seen.kills} | {seen.in_a_write} | {seen.steps} | "
                f"{seen.repeated} | {seen.wrong_samples} | {seen.wrong_losses} | {equal} |"
            )
    return rows


PARTS: dict[str, Callable[[Path, int], None]] = {"kills": kills}
TABLES: dict[str, Callable[[Path], list[str]]] = {"kills": kills_table}


def main() -> None:
    """Do what is asked and missing, then print everything."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path)
    parser.add_argument("--parts", default=",".join(PARTS), help=f"of {', '.join(PARTS)}, or none")
    parser.add_argument("--kills", type=int, default=20, help="SIGKILLs in each cell of the matrix")
    args = parser.parse_args()
    for name in filter(None, args.parts.split(",")):
        PARTS[name](args.work, args.kills)
    for name, table in TABLES.items():
        print(f"\n{name}\n\n" + "\n".join(table(args.work)))


if __name__ == "__main__":
    main()
