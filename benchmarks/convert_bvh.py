"""What a BVH conversion costs, and whether kills or workers change a byte of it.

    python benchmarks/convert_bvh.py SOURCE WORK [--kills 5] [--seed 0]

SOURCE holds archives or .bvh files with joint_map.json, and captions.jsonl and splits/ where they exist.
Told: the floor (unpacking the source once, writing and hashing as many bytes as the shards have), parsing
alone, the conversion with one and two workers, and a finished one run again; each in wall and CPU seconds and
as a multiple of the motion's own length. Then the sha256 of every file is compared between one worker, two
workers, and a run that was killed (SIGKILL to its process group at random moments) and finished.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from motionloom.datasets.convert.bvh.convert import BvhConfig
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.common.scan import list_batches
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.motion.bvh.motion import read_bvh
from motionloom.datasets.schema import Manifest


def config_of(source: Path) -> BvhConfig:
    captions, splits = source / "captions.jsonl", source / "splits"
    return BvhConfig(
        source=source,
        joint_map=source / "joint_map.json",
        captions=captions if captions.exists() else None,
        splits=splits if splits.exists() else None,
        licence="as the source states",
    )


def child(source: Path, out: Path, workers: int) -> list[str]:
    return [sys.executable, __file__, str(source), str(out), "--convert", str(workers)]


def measured(command: list[str]) -> tuple[float, float]:
    """Wall and CPU seconds of a process and its children."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True)
    wall = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def timed(work: Callable[[], object]) -> tuple[float, float]:
    start, cpu = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - start, time.process_time() - cpu


def tell(what: str, seconds: tuple[float, float], motion: float) -> None:
    wall, cpu = seconds
    print(f"{what:34s} {wall:7.1f} s wall {cpu:7.1f} s CPU {motion / wall:8.0f} x real time", flush=True)


def unpack(source: Path) -> None:
    for batch in list_batches(source, ".bvh"):
        for _ in batch.read(".bvh"):
            pass


def parse_seconds(source: Path) -> tuple[float, float, float]:
    """Wall and CPU seconds of parsing alone, without unpacking; and the length of the motion."""
    wall = cpu = motion = 0.0
    for batch in list_batches(source, ".bvh"):
        for file in batch.read(".bvh"):
            start, start_cpu = time.perf_counter(), time.process_time()
            clip = read_bvh(file.data, name=file.label)
            wall, cpu = wall + time.perf_counter() - start, cpu + time.process_time() - start_cpu
            motion += clip.frames / clip.fps
    return wall, cpu, motion


def write_bytes(path: Path, size: int) -> None:
    block, digest = os.urandom(1 << 20), hashlib.sha256()
    with path.open("wb") as file:
        for _ in range(size >> 20):
            file.write(block)
            digest.update(block)
        os.fsync(file.fileno())
    path.unlink()


def digests(out: Path) -> dict[str, str]:
    return {
        path.relative_to(out).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(out.rglob("*"))
        if path.is_file()
    }


def killed(source: Path, out: Path, kills: int, seed: int, total: int) -> int:
    """Start with two workers and kill, `kills` times; how many kills came before the end.

    A kill comes when a random number of the `total` batches and shards is finished, and up to a second later:
    moments by the clock would depend on what else the machine does.
    """
    chance, done = random.Random(seed), 0
    for moment in sorted(chance.sample(range(total - 2), kills)):
        process = subprocess.Popen(child(source, out, 2), start_new_session=True)
        while process.poll() is None and sum(finished(out)) < moment:
            time.sleep(0.01)
        time.sleep(chance.uniform(0, min(1.0, 0.1 * (total - moment))))
        done += process.poll() is None
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        batches, shards = finished(out)
        torn = len(list(out.rglob("*.tmp")))
        print(f"killed: {batches} batches, {shards} shards finished, {torn} half-written files", flush=True)
    subprocess.run(child(source, out, 2), check=True)
    return done


def finished(out: Path) -> tuple[int, int]:
    """Batches and shards of an unfinished run."""
    return len(list(out.glob(".work/0*.json"))), len(list(out.glob("*.index.json")))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--convert", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.convert:
        config, workers = config_of(args.source), args.convert
        prepared = prepare(config, workers=workers, out=args.work)
        run_conversion(prepared, args.work, workers=workers, progress=False)
        return
    args.work.mkdir(parents=True, exist_ok=True)
    one, two, broken = (args.work / name for name in ("one", "two", "killed"))
    for folder in (one, two, broken):
        shutil.rmtree(folder, ignore_errors=True)
    print(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores", flush=True)
    floor = timed(lambda: unpack(args.source))
    *parsing, motion = parse_seconds(args.source)
    print(f"{motion:.0f} s of motion in {args.source.name}", flush=True)
    seconds = {workers: measured(child(args.source, out, workers)) for workers, out in ((1, one), (2, two))}
    again = measured(child(args.source, two, 2))
    size = sum(shard.bytes for shard in Manifest.load_json(one / "manifest.json").shards)
    writing = timed(lambda: write_bytes(args.work / "bytes", size))
    tell("floor: unpack once", floor, motion)
    tell(f"floor: write and hash {size >> 20} MiB", writing, motion)
    tell("parse alone, unpacked", (parsing[0], parsing[1]), motion)
    tell("convert, 1 worker", seconds[1], motion)
    tell("convert, 2 workers", seconds[2], motion)
    tell("the same again, finished", again, motion)
    total = len(list_batches(args.source, ".bvh")) + finished(one)[1]
    kills = killed(args.source, broken, args.kills, args.seed, total)
    want = digests(one)
    verdicts = {"2 workers": digests(two) == want, f"killed {kills} times": digests(broken) == want}
    print(json.dumps({"files": len(want), "equal to 1 worker": verdicts}))
    raise SystemExit(0 if all(verdicts.values()) else 1)


if __name__ == "__main__":
    main()
