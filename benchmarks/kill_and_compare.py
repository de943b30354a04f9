"""Kill a run with SIGKILL twice, restart it, and compare every artifact with an undisturbed run's.

    python benchmarks/kill_and_compare.py RECIPE WORK [--set key=value ...]

The kills come once the tokenizer and once the GPT have written a checkpoint.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import signal
import subprocess
import time
from pathlib import Path


def command(recipe: str, out: Path, sets: list[str]) -> list[str]:
    overrides = [part for value in sets for part in ("--set", value)]
    return ["motionloom", "run", recipe, "--out", str(out), *overrides]


def digests(run: Path) -> dict[str, str]:
    found = sorted((run / "stages").glob("*/artifact.json"))
    return {path.parent.name: hashlib.sha256(path.read_bytes()).hexdigest()[:16] for path in found}


def run_until(args: list[str], stage: Path) -> None:
    """Start, wait for a checkpoint of `stage`, let it go on for a moment, SIGKILL the whole group."""
    process = subprocess.Popen(args, start_new_session=True, stdout=subprocess.DEVNULL)
    while not list(stage.glob("checkpoints/*.ckpt")):
        if process.poll() is not None:
            raise SystemExit(f"the run ended before {stage.name} had a checkpoint; raise its steps")
        time.sleep(0.2)
    time.sleep(3.0)
    assert process.poll() is None, f"{stage.name} ended before the kill; raise its steps"
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    print(f"killed in {stage.name}; its artifact exists: {(stage / 'artifact.json').exists()}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recipe")
    parser.add_argument("work", type=Path)
    parser.add_argument("--set", dest="sets", action="append", default=[])
    args = parser.parse_args()
    calm, killed = args.work / "calm", args.work / "killed"
    subprocess.run(command(args.recipe, calm, args.sets), check=True)
    for stage in ("tokenizer", "gpt"):
        run_until(command(args.recipe, killed, args.sets), killed / "stages" / stage)
    subprocess.run(command(args.recipe, killed, args.sets), check=True)
    one, two = digests(calm), digests(killed)
    for stage in one:
        verdict = "equal" if one[stage] == two.get(stage) else "DIFFERS"
        print(f"{stage:10s} {one[stage]} {two.get(stage)} {verdict}")
    raise SystemExit(0 if one == two else 1)


if __name__ == "__main__":
    main()
