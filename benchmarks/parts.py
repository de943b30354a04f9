"""Many small BVH files converted in parts: python benchmarks/parts.py FOLDER [CLIPS]

Whole by one process, in eight parts one after the other, and as an array on the tests' SLURM, where one part
is killed and given again: equal files, and seconds of processor time.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from bvh_clips import write_clip, write_map
from slurm_cluster import Cluster

PARTS = 8
PROGRAM = [sys.executable, "-P", "-m", "motionloom.pipeline.cli.main"]


def shards(run: Path) -> dict[Path, bytes]:
    data = run / "stages/data/shards"
    found = (path for path in data.rglob("*") if path.is_file())
    return {path.relative_to(data): path.read_bytes() for path in found}


def cost(*words: object) -> float:
    before = sum(os.times()[2:4])  # of children
    subprocess.run([*PROGRAM, *words], check=True, stdout=subprocess.DEVNULL)
    return sum(os.times()[2:4]) - before


def launch(cluster: Cluster, recipe: Path, run: Path, kill: str = "") -> None:
    """Submit and wait; the part `kill` is killed once it runs."""
    words = ["--cluster", f"parts={PARTS}", "--cluster", "cpus=1", "--cluster", "memory_gb=2"]
    cost("launch", recipe, "--gpus-per-node", "0", "-o", run, *words)
    while queue := cluster.ask("squeue", "-h", "-t", "PD,R,CG", "-o", "%F_%K %T"):
        for job, state in (line.split() for line in queue.splitlines()):
            if kill and job.endswith(f"_{kill}") and state == "RUNNING":
                time.sleep(20)  # in the midst of its shards
                cluster.ask("scancel", "--signal=KILL", "--full", job)
                kill = ""
        time.sleep(0.5)


def main(folder: Path, clips: int) -> None:
    for number in range(clips):
        write_clip(folder / f"mocap/{number // 500:03d}/clip{number:05d}.bvh", number, frames=36)
    joints, recipe = write_map(folder / "map.json"), folder / "convert.yaml"
    settings = f"kind: bvh, source: {folder}/mocap, joint_map: {joints}, licence: CC0-1.0, fps: 20"
    recipe.write_text(f"name: c\nhardware: {{convert_workers: 1}}\nstages:\n  data: {{{settings}}}\n")
    whole = cost("run", recipe, "-o", folder / "whole")
    wanted, run = shards(folder / "whole"), folder / "parts"
    parts = [cost("run", recipe, "-o", run, "--set", f"hardware.part={n + 1}/{PARTS}") for n in range(PARTS)]
    join = cost("run", recipe, "-o", run)
    print(f"{whole:.0f} s, parts {[*map(round, parts)]}, join {join:.0f}; equal: {shards(run) == wanted}")
    with Cluster() as cluster:
        os.environ |= cluster.environment
        launch(cluster, recipe, folder / "array", kill="3")
        print(f"part 3 killed, equal: {shards(folder / 'array') == wanted}")
        launch(cluster, recipe, folder / "array")
        print(f"given again, equal: {shards(folder / 'array') == wanted}")


if __name__ == "__main__":
    main(Path(sys.argv[1]).absolute(), int(sys.argv[2]) if len(sys.argv) > 2 else 20000)
