"""Damaged shards end a run before a stage reads them; sound ones are compared once."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.schema import ShardInfo, UserError
from motionloom.datasets.shards.checksums import LocalShard
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.launch.process import JointError
from motionloom.pipeline.launch.team import Team
from motionloom.pipeline.runs import verify_shards as sound
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.plan import Selection
from motionloom.pipeline.runs.verify_shards import NOTE, compare_shards, verify_shards

QUIET = Console(quiet=True)


@pytest.fixture
def shards(tmp_path: Path) -> list[LocalShard]:
    rng = np.random.default_rng(0)
    made = []
    for number in range(5):
        path = tmp_path / f"x-train-{number:06d}.tar"
        path.write_bytes(rng.bytes(3000 + number))
        facts = {"samples": 1, "frames": 1, "bytes": 3000 + number, "sha256": sha256_of(path)}
        made.append(LocalShard(path, ShardInfo(name=path.name, split="train", **facts)))
    return made


@pytest.fixture
def compared(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, list[str]]]:
    """(thread, files) of each comparison."""
    seen: list[tuple[str, list[str]]] = []
    problems = sound.problems

    def look(todo: Sequence[LocalShard], *rest: Any) -> list[str]:
        seen.append((threading.current_thread().name, [shard.path.name[8:14] for shard in todo]))
        return problems(todo, *rest)

    monkeypatch.setattr(sound, "problems", look)
    return seen


def flip(path: Path, place: int, bit: int = 0) -> None:
    raw = bytearray(path.read_bytes())
    raw[place] ^= 1 << bit
    path.write_bytes(raw)


def test_every_flipped_bit_is_found(shards: list[LocalShard], tmp_path: Path) -> None:
    """Each behind a comparison that found all well; the file's time of writing is set back."""
    path, record = shards[2].path, tmp_path / NOTE
    for place, bit in np.random.default_rng(1).integers((3002, 8), size=(25, 2)).tolist():
        compare_shards(shards, record, Team(), QUIET)
        before = path.stat()
        flip(path, place, bit)
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
        with pytest.raises(JointError, match=r"x-train-000002\.tar: the sha256"):
            compare_shards(shards, record, Team(), QUIET)
        flip(path, place, bit)


def test_what_has_not_changed_is_compared_once(
    shards: list[LocalShard], tmp_path: Path, compared: list[tuple[str, list[str]]]
) -> None:
    record = tmp_path / NOTE
    assert compare_shards(shards, record, Team(), QUIET) == sum(shard.info.bytes for shard in shards)
    assert compare_shards(shards, record, Team(), QUIET) == 0
    shards[3].path.touch()
    assert compare_shards(shards, record, Team(), QUIET) == 3003
    other = shards[4].info.model_copy(update={"sha256": "0" * 64})  # the manifest is another
    with pytest.raises(JointError, match="000004"):
        compare_shards([*shards[:4], LocalShard(shards[4].path, other)], record, Team(), QUIET)
    compare_shards(shards, record, Team(), QUIET, again=True)
    record.write_text("{")
    compare_shards(shards, record, Team(), QUIET)
    everything = [f"{number:06d}" for number in range(5)]
    assert [files for _, files in compared] == [everything, ["000003"], ["000004"], everything, everything]


def test_missing_and_short_shards_are_named_with_how_many_there_are(
    shards: list[LocalShard], tmp_path: Path
) -> None:
    shards[1].path.unlink()
    shards[4].path.write_bytes(b"x")
    with pytest.raises(JointError, match=r"000001\.tar: .*missing.*\(2 such"):
        compare_shards(shards, tmp_path / NOTE, Team(), QUIET)
    assert not (tmp_path / NOTE).exists()


class Threads(Team):
    """A team of three threads, which `gather` brings together."""

    barrier: threading.Barrier
    given: dict[int, Any]

    def gather(self, mine: Any) -> list[Any]:
        self.given[self.rank] = mine
        self.barrier.wait()
        found = [self.given[rank] for rank in range(self.world)]
        self.barrier.wait()
        return found


@pytest.fixture
def together(
    shards: list[LocalShard], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[], list[int | str]]:
    """Ranks 0 and 1 see the same files, rank 2 a copy of its own under the same names."""
    state = LocalShard.state

    def seen(shard: LocalShard) -> list[int]:
        here = state(shard)
        return [*here[:3], here[3] + 1] if threading.current_thread().name == "2" else here

    monkeypatch.setattr(LocalShard, "state", seen)

    def go() -> list[int | str]:
        kind = type("Now", (Threads,), {"barrier": threading.Barrier(3, timeout=30), "given": {}})

        def rank(number: int) -> int | str:
            threading.current_thread().name = str(number)
            try:
                return compare_shards(shards, tmp_path / NOTE, kind(number, 3), QUIET)
            except JointError as error:
                return str(error)

        with ThreadPoolExecutor(3) as pool:
            return list(pool.map(rank, range(3)))

    return go


def test_processes_share_the_files_that_they_both_see(
    together: Callable[[], list[int | str]], shards: list[LocalShard], compared: list[tuple[str, list[str]]]
) -> None:
    everything = sum(shard.info.bytes for shard in shards)
    first = together()
    assert first[2] == everything and int(first[0]) + int(first[1]) == everything
    assert sorted(compared) == [
        ("0", ["000000", "000002", "000004"]),
        ("1", ["000001", "000003"]),
        ("2", ["000000", "000001", "000002", "000003", "000004"]),
    ]
    assert together() == [0, 0, 0]
    flip(shards[3].path, 7)
    ends = together()
    assert len(set(ends)) == 1 and "000003.tar: the sha256" in str(ends[0])


def test_processes_look_when_all_are_here(
    shards: list[LocalShard], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that comes before the lead has made the data would see none, and wait for the others for ever."""
    there: list[LocalShard] = []

    class Late(Team):
        def meet(self) -> None:
            there.extend(shards)

    monkeypatch.setattr(sound.Data, "local_shards", lambda data: list(there))
    data = SimpleNamespace(gives=lambda what: what == "data", exported=False, folder=tmp_path)
    context: Any = SimpleNamespace(hardware=Hardware(), again=None, inputs={"data": data}, console=QUIET)
    flip(shards[1].path, 5)
    with pytest.raises(JointError, match="000001"):
        verify_shards(context, Late(), tmp_path)


RECIPE = """
name: x
hardware: {accelerator: cpu, threads: 1, convert_workers: 1, loggers: []}
stages:
  data: {kind: synth, clips: 8}
  stats: {kind: stats}
"""


def test_a_stage_does_not_begin_on_damaged_shards(tmp_path: Path) -> None:
    recipe, run = tmp_path / "x.yaml", tmp_path / "run"
    recipe.write_text(RECIPE)
    run_recipe(recipe, run, console=QUIET)
    path = next((run / "stages/data/shards").glob("*-train-*.tar"))
    assert str(path) in json.loads((run / NOTE).read_text())["files"]
    flip(path, path.stat().st_size // 2)
    again = Selection(first="stats")
    with pytest.raises(UserError, match=f"{path.name}: the sha256"):
        run_recipe(recipe, run, select=again, console=QUIET)
    run_recipe(recipe, run, select=again, overrides=["hardware.verify_shards=never"], console=QUIET)
