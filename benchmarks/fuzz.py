"""Read damaged files, sources and requests, and count what is no answer: exceptions other than a sentence,
more than two CPU seconds, more memory than 20 times the input and 200 MB.

    python benchmarks/fuzz.py WORK --hours 4               # all readers in turn; again: goes on where it was
    python benchmarks/fuzz.py WORK --inputs 2000 --readers bvh,"convert beat2" --seed 3
    python benchmarks/fuzz.py WORK --record                # writes the counts into SECURITY.md and records/

Counts are in WORK/counts.json, failing inputs in WORK/failing. The seeds are made by our own writers; damage
keeps lengths and checksums right, so that it goes deep (`fuzzing/`). One core is used.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import time
from datetime import date
from pathlib import Path

from fuzzing import files, models, requests, stores, trees  # noqa: F401 - they fill the table
from fuzzing.table import READERS, ROOT, missing
from fuzzing.worker import Count, Worker, as_record

_SLICE = 8.0
"""CPU seconds of one reader before it is the next one's turn."""
_RECORD = ROOT / "benchmarks/records/fuzzing.json"
_LINE = re.compile(r"- \*\*Fuzzed\*\*.*?(?=\n- |\n\n)", re.DOTALL)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("work", type=Path, help="folder of counts and failing inputs")
    parser.add_argument("--hours", type=float, default=0.0, help="CPU hours for all readers together")
    parser.add_argument("--inputs", type=int, default=0, help="inputs of each reader")
    parser.add_argument("--readers", default="", help="names, separated by commas; default: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--record", action="store_true", help="write what was counted into SECURITY.md")
    given = parser.parse_args()
    if lacking := missing():
        sys.exit("\n".join(lacking))
    names = given.readers.split(",") if given.readers else list(READERS)
    if unknown := [name for name in names if name not in READERS]:
        sys.exit(f"no reader {unknown[0]!r}; there are {', '.join(READERS)}")
    given.work.mkdir(parents=True, exist_ok=True)
    counts = read_counts(given.work, given.seed)
    if given.inputs or given.hours:
        run(given.work.resolve(), names, counts, given.seed, given.inputs, given.hours * 3600)
    print(table(counts))
    if given.record:
        record(counts)
    sys.exit(any(count.unexpected or count.slow or count.large for count in counts.values()))


def read_counts(work: Path, seed: int) -> dict[str, Count]:
    """The counts of a folder; they must be of one seed."""
    path = work / "counts.json"
    if not path.is_file():
        return {}
    stored = json.loads(path.read_text())
    if stored["seed"] != seed:
        sys.exit(f"{work}: its inputs are of --seed {stored['seed']}; give that, or another folder")
    return {name: Count(**count) for name, count in stored["readers"].items()}


def run(
    work: Path, names: list[str], counts: dict[str, Count], seed: int, inputs: int, seconds: float
) -> None:
    """Read inputs of each reader: so many each, or in turn until the CPU seconds are over."""
    todo = list(names)
    spent = 0.0
    while todo:
        name = todo.pop(0)
        count = counts.setdefault(name, Count())
        worker = Worker(READERS[name], seed, work / "failing")
        made = worker.run(count.inputs, inputs or 10**9, float("inf") if inputs else _SLICE)
        count.add(made)
        spent += made.cpu_seconds
        (work / "counts.json").write_text(
            json.dumps({"seed": seed, "readers": {k: as_record(v) for k, v in counts.items()}}, indent=1)
        )
        print(
            f"{time.strftime('%H:%M:%S')} {name}: {count.inputs:,} inputs, {made.cpu_seconds:.0f} s"
            + "".join(f"\n    {number} x {place}" for place, number in made.places.items()),
            flush=True,
        )
        if not inputs and spent < seconds:
            todo.append(name)


def table(counts: dict[str, Count]) -> str:
    """The counts as a table for a terminal."""
    titles = ("inputs", "refused", "taken", "unexpected", "> 2 s", "large", "most s", "most MB")
    lines = [f"{'reader':24}" + "".join(f"{title:>11}" for title in titles)]
    for name, one in {**counts, "all": total(counts)}.items():
        numbers = (one.inputs, one.refused, one.taken, one.unexpected, one.slow, one.large)
        most = f"{one.slowest_seconds:11.2f}{one.largest_mb:11.0f}"
        lines.append(f"{name:24}" + "".join(f"{number:11,}" for number in numbers) + most)
    return "\n".join(lines)


def total(counts: dict[str, Count]) -> Count:
    """All readers together."""
    whole = Count()
    for count in counts.values():
        whole.add(count)
    return whole


def record(counts: dict[str, Count]) -> None:
    """Write the counts into `records/fuzzing.json`, and date, commit, command and sums into SECURITY.md."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short=8", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()
    whole = total(counts)
    today = date.today()
    facts = {
        "date": today.isoformat(),
        "commit": commit,
        "readers": {name: as_record(one) for name, one in counts.items()},
    }
    _RECORD.write_text(json.dumps(facts, indent=1) + "\n")
    wrong = whole.unexpected + whole.slow + whole.large
    read = f"{whole.refused:,} ended in a sentence and {whole.taken:,} were read"
    line = (
        f"- **Fuzzed** on {today.day} {today:%B %Y}, at {commit}, by `python benchmarks/fuzz.py`:\n"
        f"  of {whole.inputs:,} damaged inputs of {len(counts)} readers, converters and requests\n"
        f"  {read};\n"
        f"  {wrong or 'none'} raised, took over 2 s, or 20 times their size and 200 MB\n"
        f"  (`benchmarks/records/fuzzing.json`). Whether what was read is right is not compared."
    )
    page = ROOT / "SECURITY.md"
    page.write_text(_LINE.sub(lambda _: line, page.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
