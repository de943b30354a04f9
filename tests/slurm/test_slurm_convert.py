"""Conversion as SLURM job arrays, on a real cluster of two nodes: same bytes, and what happens on failure."""

from __future__ import annotations

import hashlib
import io
import json
import tarfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from slurm_cluster import Cluster, why_not

from motionloom.datasets.motion.bvh import write_bvh
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError
from motionloom.pipeline.launch.convert_job import ConvertJob, run_part
from motionloom.pipeline.launch.slurm_convert import LOG_FOLDER, ClusterConfig, submit_conversion, wait_for

pytest.importorskip("submitit")


pytestmark = [
    pytest.mark.slurm,
    pytest.mark.skipif(bool(why_not()), reason=why_not()),
]
SPLITS = ("train", "train", "train", "val", "test")
SHARDS = {"clips_per_shard": 3}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with Cluster() as started, pytest.MonkeyPatch.context() as patch:
        for name, value in started.environment.items():
            patch.setenv(name, value)
        yield started


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four archives of five two-second clips each, in which an arm swings."""
    folder = tmp_path_factory.mktemp("source")
    skeleton = Skeleton.named("smpl22")
    captions = []
    for part in range(4):
        with tarfile.open(folder / f"part{part}.tar.xz", "w:xz") as archive:
            for number in range(5):
                clip_id = f"clip{part}{number}"
                write_bvh(folder / "clip.bvh", skeleton, swing(part * 5 + number), np.zeros((60, 3)), 30.0)
                data = (folder / "clip.bvh").read_bytes()
                member = tarfile.TarInfo(f"{clip_id}.bvh")
                member.size = len(data)
                archive.addfile(member, io.BytesIO(data))
                captions.append({"id": clip_id, "captions": ["an arm swings"], "split": SPLITS[number]})
    (folder / "clip.bvh").unlink()
    (folder / "captions.jsonl").write_text("\n".join(map(json.dumps, captions)))
    rows = [[index, name, name] for index, name in enumerate(skeleton.joints)]
    (folder / "map.json").write_text(json.dumps({"smpl22": rows}))
    return folder


def swing(seed: int) -> np.ndarray:
    """Local rotations [60, 22, 3, 3]: the left shoulder turns about Z."""
    angle = np.sin(np.arange(60) / 9 + seed)
    out = np.tile(np.eye(3), (60, 22, 1, 1))
    shoulder = Skeleton.named("smpl22").index("left_shoulder")
    out[:, shoulder, 0, 0] = out[:, shoulder, 1, 1] = np.cos(angle)
    out[:, shoulder, 1, 0] = np.sin(angle)
    out[:, shoulder, 0, 1] = -out[:, shoulder, 1, 0]
    return out


@pytest.fixture(scope="module")
def whole(source: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Digest of every file that one machine writes."""
    out = tmp_path_factory.mktemp("whole") / "out"
    run_part(ConvertJob(kind="bvh", fields=fields(source), out=out, **SHARDS))
    made = digests(out)
    assert len([name for name in made if name.endswith(".tar")]) == 4 + 2 + 2
    return made


def fields(source: Path) -> dict[str, Any]:
    return {
        "source": source,
        "joint_map": source / "map.json",
        "captions": source / "captions.jsonl",
        "licence": "CC0",
    }


def digests(out: Path) -> dict[str, str]:
    return {
        path.relative_to(out).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in out.rglob("*")
        if path.is_file() and path.relative_to(out).parts[0] != LOG_FOLDER
    }


def submit(source: Path, out: Path) -> tuple[Any, Console, io.StringIO]:
    said = io.StringIO()
    console = Console(file=said, width=200)
    asked = ClusterConfig.from_words(
        ["partition=main", "tasks=2", "cpus_per_task=1", "memory_gb=1", "time_minutes=10"]
    )
    return (
        submit_conversion("bvh", fields(source), out, cluster=asked, console=console, **SHARDS),
        console,
        said,
    )


@pytest.mark.timeout(600)
def test_arrays_give_the_bytes_of_one_machine(
    cluster: Any, source: Path, whole: dict[str, str], tmp_path: Path
) -> None:
    submission, console, said = submit(source, tmp_path / "out")
    first, second, third = submission.ids
    told = said.getvalue()
    assert f"features: job {first}, 2 tasks\n" in told
    assert f"shards: job {second}, 2 tasks, after job {first}\n" in told
    assert f"manifest: job {third}, 1 task, after job {second}\n" in told
    assert f"squeue --jobs {first},{second},{third}" in told and f"scancel {first} {second} {third}" in told
    manifest = wait_for(submission, console, poll_seconds=0.5)
    assert sum(shard.samples for shard in manifest.shards) == 20
    assert digests(tmp_path / "out") == whole


@pytest.mark.timeout(600)
def test_a_killed_task_stops_the_chain_and_the_next_try_makes_the_rest(
    cluster: Any, source: Path, whole: dict[str, str], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    submission, console, _ = submit(source, out)
    shards, last = submission.links[1].job, submission.links[2].job
    deadline = time.monotonic() + 300
    while "R" not in cluster.ask("squeue", "-h", "-o", "%t", f"--jobs={shards}_1").split():
        assert time.monotonic() < deadline, "the array of shards never ran"
        time.sleep(0.05)
    cluster.ask("scancel", "--signal=KILL", f"{shards}_1")
    with pytest.raises(UserError) as failure:
        wait_for(submission, console, poll_seconds=0.5)
    told = str(failure.value)
    assert told.startswith(f"shards job {shards}: task 1 of 2 failed: killed, out of memory or out of time")
    assert f"cancelled: manifest job {last}" in told and f"{shards}_1_0_log.err" in told
    assert not (out / "manifest.json").exists()
    kept = {path.name: path.stat().st_mtime_ns for path in out.glob("*.tar")}
    assert len(kept) == 4  # those of task 0
    again, console, _ = submit(source, out)
    wait_for(again, console, poll_seconds=0.5)
    assert digests(out) == whole
    assert {name: (out / name).stat().st_mtime_ns for name in kept} == kept


def test_what_sbatch_refuses_is_said_and_leaves_no_jobs(cluster: Any, source: Path, tmp_path: Path) -> None:
    asked = ClusterConfig(partition="nowhere", tasks=2)
    with pytest.raises(UserError, match=r"sbatch refused the features job: .*partition"):
        submit_conversion(
            "bvh", fields(source), tmp_path / "out", cluster=asked, console=Console(file=io.StringIO())
        )
    assert cluster.ask("squeue", "-h", "-o", "%A") == ""
