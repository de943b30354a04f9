"""Shards: byte-identical for any worker count and after any kill, readable by WebDataset, manifest last."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import pickle
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from shard_samples import digests

from motionloom.datasets.base import files
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.lock import LOCK_FILE, folder_lock
from motionloom.datasets.base.records import Dropped
from motionloom.datasets.check.dataset import check
from motionloom.datasets.loading.order import stream_rows
from motionloom.datasets.loading.plan import BatchPlan, Share
from motionloom.datasets.shards import tasks
from motionloom.datasets.shards.clips import Source
from motionloom.datasets.shards.left_out import LEFT_OUT_FILE, grouped, kind_of_reason, tally, write_left_out
from motionloom.datasets.shards.options import Part, WriteOptions
from motionloom.datasets.shards.reader import ShardDataset


def test_any_number_of_workers_writes_the_same_bytes(made: ModuleType, tmp_path: Path) -> None:
    convert = made.Convert(drop=(3, 17), bad=(8,))
    for workers in (1, 3):
        made.write(tmp_path / str(workers), convert=convert, workers=workers)
    first = digests(tmp_path / "1")
    # 36, 12 and 12 clips at 8 a shard, an index each; index, manifest, card and the list of what is left out
    assert len(first) == 2 * (5 + 2 + 2) + 4
    assert digests(tmp_path / "3") == first


def test_manifest_and_drops(made: ModuleType, tmp_path: Path) -> None:
    manifest = made.write(tmp_path, convert=made.Convert(drop=(3,), bad=(8,)))
    reasons = {drop.source: drop.reason for drop in manifest.dropped}
    assert reasons == {"3": "on the ignore list", "8": "RuntimeError: unreadable"}
    for shard in manifest.shards:
        content = (tmp_path / shard.name).read_bytes()
        assert (shard.bytes, shard.sha256) == (len(content), hashlib.sha256(content).hexdigest())
    assert sum(shard.samples for shard in manifest.shards) == 58
    assert json.loads((tmp_path / "manifest.json").read_text())["shards"][0]["samples"] == 8
    with pytest.raises(UserError, match=r"^8: RuntimeError: unreadable"):
        made.write(tmp_path / "strict", convert=made.Convert(drop=(3,), bad=(8,)), strict=True)


def test_clips_are_shuffled_over_shards_by_the_seed(made: ModuleType, tmp_path: Path) -> None:
    made.write(tmp_path / "a", seed=0)
    made.write(tmp_path / "b", seed=1)
    one, other = (ShardDataset.open(tmp_path / name, "train").ids for name in "ab")
    in_order = [f"clip-ä-{i}" for split, i in made.items(60) if split == "train"]
    assert sorted(one) == sorted(other) == sorted(in_order)
    assert one != other and one != in_order


def test_ten_new_clips_touch_ten_shards(made: ModuleType) -> None:
    """Whatever the order in which a set grows, its shards are the same, and each is a prefix of the hash."""

    def planned(count: int) -> dict[str, tuple[str, set[str]]]:
        how = WriteOptions(clips_per_shard=16)
        items = made.items(count)
        shards = tasks.plan_shards(Path(), items[::-1], made.facts(), how, str, str)
        assert sorted(item.item for one in shards for item in one.items) == [*range(count)]
        assert max(len(one.items) for one in shards) <= 16 and len({one.path for one in shards}) == len(
            shards
        )
        assert len(shards) < 2 * count / 16
        return {one.path.name: (one.fingerprint, {item.name for item in one.items}) for one in shards}

    before, after = planned(3000), planned(3010)
    touched = {name for name, shard in before.items() if after.get(name) != shard}
    assert len(touched) <= 10 and len(after.keys() - before.keys()) <= 2 * len(before.keys() - after.keys())
    for name in before.keys() - after.keys():
        split, number = name.removesuffix(".tar").rsplit("-", 1)
        halves = [after[f"{split}-{2 * int(number) + bit:06d}.tar"][1] for bit in (1, 2)]
        assert before[name][1] <= halves[0] | halves[1], "a full shard is split in two"


SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
import shard_samples as made
if __name__ == "__main__":
    out, mark = Path(sys.argv[1]), Path(sys.argv[2])
    at, workers, parent = (int(value) for value in sys.argv[3:])
    made.write(out, convert=made.Convert(kill_at=at, mark=mark, kill_parent=bool(parent)), workers=workers)
"""


@pytest.mark.parametrize(
    ("workers", "kill_parent"), [(1, False), pytest.param(2, False, marks=pytest.mark.slow), (2, True)]
)
def test_killed_and_run_again_gives_the_same_bytes(
    made: ModuleType, tmp_path: Path, workers: int, kill_parent: bool
) -> None:
    made.write(tmp_path / "whole")
    want = digests(tmp_path / "whole")
    script = tmp_path / "convert.py"
    script.write_text(SCRIPT.format(tests=str(Path(__file__).parents[2] / "helpers")))
    out = tmp_path / "killed"
    told = [out, tmp_path / "mark", 26, workers, int(kill_parent)]
    command = [sys.executable, str(script), *map(str, told)]
    first = subprocess.run(command, capture_output=True, text=True)
    assert first.returncode != 0 and (tmp_path / "mark").exists()
    assert not (out / "manifest.json").exists()
    if workers == 2 and not kill_parent:
        assert "worker" in first.stderr and "Traceback" not in first.stderr.splitlines()[-1]
    if kill_parent:
        time.sleep(0.5)
        assert not [p for p in Path("/proc").glob("[0-9]*/environ") if same_tree(p, script)]
    kept = {path.name: path.stat().st_mtime_ns for path in finished_shards(out)}
    assert subprocess.run(command, capture_output=True).returncode == 0
    assert digests(out) == want
    for name, changed in kept.items():
        assert (out / name).stat().st_mtime_ns == changed, "a finished shard was written again"


def finished_shards(out: Path) -> list[Path]:
    """Tars whose index is there too; a worker may be killed between the two."""
    return [path for path in out.glob("*.tar") if path.with_suffix(".index").exists()]


def same_tree(environ: Path, script: Path) -> bool:
    """Whether a live process was started for our script."""
    try:
        return str(script) in (environ.parent / "cmdline").read_text()
    except OSError:
        return False


def test_damaged_or_differently_made_shards_are_not_kept(made: ModuleType, tmp_path: Path) -> None:
    made.write(tmp_path / "a")
    want = digests(tmp_path / "a")
    shard = tmp_path / "a" / "made-train-000001.tar"
    content = bytearray(shard.read_bytes())
    content[5000] ^= 1
    shard.write_bytes(content)
    made.write(tmp_path / "a")
    assert digests(tmp_path / "a") == want

    (tmp_path / "a" / "manifest.json").unlink()  # as if it had not been finished
    made.write(tmp_path / "a", count=40)
    made.write(tmp_path / "b", count=40)
    assert digests(tmp_path / "a") == digests(tmp_path / "b"), "shards of the longer plan must go"


def test_bad_samples_are_dropped_with_the_reason(made: ModuleType, tmp_path: Path) -> None:
    def convert(i: int) -> object:
        sample = made.clip(i)
        motion = sample.motion.copy()
        if i in (1, 5):
            motion[7, 3] = {1: 70_000.0, 5: np.nan}[i]
        return replace(sample, motion=motion[:, :100] if i == 6 else motion)

    dropped = {
        "5": "ValueError: motion: NaN or infinity in row 7",
        "6": "ValueError: motion is [26, 100], layout body133 wants [T >= 1, 133]",
    }
    too_large = {"1": "ValueError: motion: NaN or infinity in row 7"}
    for stored, expected in (("float32", dropped), ("float16", dropped | too_large)):
        manifest = made.write(tmp_path / stored, convert=convert, motion_type=stored)
        assert {drop.source: drop.reason for drop in manifest.dropped} == expected
    with pytest.raises(UserError, match="row 7"):
        made.write(tmp_path / "strict", convert=convert, strict=True)


def test_one_item_may_give_many_clips_and_float16(made: ModuleType, tmp_path: Path) -> None:
    def convert(i: int) -> object:
        sample = made.clip(i)
        mirrored = sample.meta.model_copy(update={"id": f"M{sample.meta.id}", "mirror_of": sample.meta.id})
        return [sample, type(sample)(mirrored, -sample.motion, sample.texts)]

    made.write(tmp_path, convert=convert, motion_type="float16")
    dataset = ShardDataset.open(tmp_path, "val")
    assert len(dataset) == 24
    assert dataset.motion(0).dtype == np.float32
    number = int(dataset.ids[0].rpartition("-")[2])
    np.testing.assert_array_equal(
        dataset.motion(0), made.clip_motion(number).astype(np.float16).astype(np.float32)
    )
    np.testing.assert_array_equal(dataset.motion(1), -dataset.motion(0))
    assert check(tmp_path) == []
    assert dataset.meta(1).mirror_of == dataset.ids[0] and dataset.meta(1).split == "val"


def test_parts_of_several_kinds_of_processor_are_noted(
    made: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number, kind in enumerate(("x86_64 AVX2", "x86_64 AVX512")):
        monkeypatch.setattr(tasks, "_processor", lambda kind=kind: kind)
        made.write(tmp_path, part=Part(number + 1, 2))
    (note,) = made.write(tmp_path).notes
    assert "(x86_64 AVX2, x86_64 AVX512)" in note
    assert made.write(tmp_path, clips_per_shard=10).notes == [note], "clips that are taken over bring theirs"
    one = {"out": tmp_path / "of one", "options": {}}
    assert not made.write(count=30, **one).notes
    monkeypatch.setattr(tasks, "_processor", lambda: "x86_64 AVX2")
    assert not made.write(count=20, **one).notes
    assert made.write(count=40, **one).notes == [note]


def test_parts_work_at_once_and_leave_each_others_files(made: ModuleType, tmp_path: Path) -> None:
    stranger = tmp_path / ".made-train-000001.tar.0123456789abcdef.tmp"

    def convert(i: int) -> object:
        stranger.touch()
        made.write(tmp_path, part=Part(2, 2))  # another part, while this one writes
        with pytest.raises(UserError, match=tmp_path.name):
            made.write(tmp_path)
        return made.clip(i)

    made.write(tmp_path, convert=convert, part=Part(1, 2))
    assert stranger.exists(), "a part must not clean up: the file may be another part's"
    made.write(tmp_path)
    assert not stranger.exists() and not (tmp_path / LOCK_FILE).exists()


def test_a_part_is_refused_while_a_whole_run_writes(made: ModuleType, tmp_path: Path) -> None:
    def convert(i: int) -> object:
        with pytest.raises(UserError, match=tmp_path.name):
            made.write(tmp_path, part=Part(1, 2))
        return made.clip(i)

    made.write(tmp_path, count=5, convert=convert)
    with pytest.raises(UserError, match="part 3/2"):
        Part(3, 2)


def test_a_lock_that_was_removed_meanwhile_is_taken_anew(tmp_path: Path) -> None:
    for _ in range(3):
        with folder_lock(tmp_path):
            assert (tmp_path / LOCK_FILE).exists()
        assert not (tmp_path / LOCK_FILE).exists()
    with folder_lock(tmp_path, shared=True):
        (tmp_path / LOCK_FILE).unlink()
        with folder_lock(tmp_path, shared=True), pytest.raises(UserError), folder_lock(tmp_path):
            pass


def test_a_finished_set_is_found_where_nothing_can_be_written(
    made: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest, before = made.write(tmp_path / "a", count=10), digests(tmp_path / "a")
    real = os.open

    def read_only(path: Any, flags: int, *how: Any, **named: Any) -> int:
        if flags & (os.O_CREAT | os.O_WRONLY | os.O_RDWR):
            raise OSError(errno.EROFS, "Read-only file system", str(path))
        return real(path, flags, *how, **named)

    monkeypatch.setattr(os, "open", read_only)
    monkeypatch.setattr(files, "atomic_path", lambda path: read_only(path, os.O_CREAT))
    assert made.write(tmp_path / "a", count=10) == manifest and digests(tmp_path / "a") == before


def test_a_file_system_without_locks_is_written_with_a_warning(
    made: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with pytest.warns(UserWarning, match="locks"):
        made.write(tmp_path, count=5)
    assert (tmp_path / "manifest.json").exists()


def drops(*reasons: str) -> list[Dropped]:
    return [Dropped(source=f"take/{k}.bvh", reason=reason) for k, reason in enumerate(reasons)]


def test_drops_are_counted_by_kind_and_grouped_by_reason() -> None:
    groups = grouped(drops("in no split file", "NaN at frame 3", "in no split file"))
    assert [(group.count, group.members[0].source) for group in groups] == [
        (2, "take/0.bvh"),
        (1, "take/1.bvh"),
    ]
    reason = "take/1.bvh: line 7 of x.txt moves at 41.5 m/s"
    kind = kind_of_reason(reason, "take/1.bvh")
    assert not any(part in kind for part in ("take", "7", "x.txt", "41.5"))
    listed = [
        *drops("no usable caption"),
        Dropped(source="take/0.bvh", reason="shorter than 1 s"),
        *(Dropped(source=name, reason="not UTF-8", kind="unreadable") for name in ("a.txt", "b.txt")),
        Dropped(source="gone", reason="listed, but not here", kind="missing"),
    ]
    assert re.findall(r"\d \w+", tally(listed)) == ["1 rejected", "2 unreadable", "1 missing"]
    assert tally([]) == ""


def test_the_list_is_one_line_each_and_goes_when_there_is_nothing(tmp_path: Path) -> None:
    names = [
        Dropped(source="a\nb.bvh", reason="odd\tname \x1b[31m", kind="unreadable"),
        *drops("no captions"),
    ]
    write_left_out(tmp_path, names)
    rows = [line.split("\t") for line in (tmp_path / LEFT_OUT_FILE).read_text().splitlines()]
    assert rows == [
        ["unreadable", "a\\nb.bvh", "odd\\tname \\x1b[31m"],
        ["rejected", "take/0.bvh", "no captions"],
    ]
    write_left_out(tmp_path, [])
    write_left_out(tmp_path, [])
    assert list(tmp_path.iterdir()) == []


# The streamed order: streams of shards side by side, other shards each epoch, the same for ever.


@pytest.mark.parametrize(("size", "streams"), [(12, 4), (16, 4), (15, 4), (2, 3), (40, 1)])
def test_streams_go_shard_by_shard_and_epochs_differ(size: int, streams: int) -> None:
    shards = np.sort(np.random.default_rng(0).integers(0, 24, 240)).astype(np.int32)
    source = Source(0, 240, shards=shards, group=streams)
    plan, steps = BatchPlan(240, size, 7, sources=(source,)), 240 // size
    met = []
    for epoch in range(3):
        table = np.array([plan.batch(epoch * steps + j)[1] for j in range(steps)])
        assert len(np.unique(table)) == steps * size > 240 - size
        for rows in stream_rows(source, size):
            own = shards[table[:, rows]].ravel()
            changes = np.count_nonzero(np.diff(own))
            assert changes == max(len(np.unique(own)) - 1, 0), "a stream finishes a shard before the next"
        met.append(table.tolist())
    assert met[0] != met[1] != met[2]
    late = pickle.loads(pickle.dumps(plan))
    assert late.batch(2 * steps)[1].tolist() == plan.batch(2 * steps)[1].tolist()


@pytest.mark.parametrize("parts", [1, 2])
@pytest.mark.parametrize("by_length", [False, True])
def test_nodes_read_the_shards_once_together(parts: int, by_length: bool) -> None:
    """At most a tenth is read by two, at the borders of streams; more ranks on a node read no more."""
    shards = np.repeat(np.arange(320, dtype=np.int32), 20)
    lengths = np.random.default_rng(0).integers(1, 99, 6400) if by_length else None
    plan = BatchPlan(6400, 64, 3, lengths, sources=(Source(0, 6400, shards=shards, group=8),))
    for nodes in (1, 2, 4):
        first: list[int] = []
        for node in range(nodes):
            ranks = [Share(rank, 2 * nodes, parts) for rank in (2 * node, 2 * node + 1)]
            steps = range(plan.batches_per_epoch * parts)
            own = [np.concatenate([plan.local(n, share)[1] for share in ranks]) for n in steps]
            read = np.unique(shards[np.concatenate(own)])
            assert len(read) <= 1.1 * 320 / nodes
            first.append(len(np.unique(shards[np.concatenate(own[:parts])])))
        assert by_length or max(first) <= 8 // nodes + 1, "shards before the first step"


def test_the_streamed_order_is_fixed_for_ever() -> None:
    """A changed order would break every running experiment's resume: these numbers may never change."""
    shards = np.array([0, 0, 0, 1, 1, 2, 2, 2], dtype=np.int32)
    plan = BatchPlan(8, 4, 3, sources=(Source(0, 8, shards=shards, group=2),))
    assert [plan.batch(k)[1].tolist() for k in range(3)] == [[3, 4, 2, 6], [1, 0, 7, 5], [2, 1, 3, 7]]
