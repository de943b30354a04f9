"""Damaged shards end a run before a stage reads them; sound ones are compared once."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import shard_samples
from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.base.records import ShardInfo
from motionloom.datasets.shards import checksums
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
def compared(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The files of each comparison."""
    seen: list[list[str]] = []
    problems = sound.problems

    def look(todo: Sequence[LocalShard], *rest: Any) -> list[str]:
        seen.append([shard.path.name[8:14] for shard in todo])
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
    shards: list[LocalShard], tmp_path: Path, compared: list[list[str]]
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
    assert compared == [everything, ["000003"], ["000004"], everything, everything]


def test_missing_and_short_shards_are_named_with_how_many_there_are(
    shards: list[LocalShard], tmp_path: Path
) -> None:
    shards[1].path.unlink()
    shards[4].path.write_bytes(b"x")
    with pytest.raises(JointError, match=r"000001\.tar: .*missing.*\(2 such"):
        compare_shards(shards, tmp_path / NOTE, Team(), QUIET)
    assert not (tmp_path / NOTE).exists()


class Other(Team):
    """A team in which another machine has found a mistake."""

    def gather(self, mine: Any) -> list[Any]:
        return [mine, ["x-train-000003.tar: the sha256 differs"]]


def test_the_first_process_of_each_machine_compares_and_all_refuse(
    shards: list[LocalShard], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record, state = tmp_path / NOTE, LocalShard.state
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert compare_shards(shards, record, Team(1, 2), QUIET) == 0 and not record.exists()
    for team in (Other(1, 4), Other(0, 4)):
        with pytest.raises(JointError, match="000003"):
            compare_shards(shards, record, team, QUIET)
    monkeypatch.setenv("LOCAL_RANK", "0")
    everything = sum(shard.info.bytes for shard in shards)
    assert compare_shards(shards, record, Team(), QUIET) == everything
    with monkeypatch.context() as elsewhere:  # a copy of its own under the same names
        elsewhere.setattr(LocalShard, "state", lambda shard: [*state(shard)[:3], state(shard)[3] + 1])
        assert [compare_shards(shards, record, Team(), QUIET) for _ in range(2)] == [everything, 0]
    assert compare_shards(shards, record, Team(), QUIET) == 0


def test_machines_that_see_one_disk_divide_its_shards(
    shards: list[LocalShard], tmp_path: Path, compared: list[list[str]]
) -> None:
    class One(Team):
        """A team whose first three machines share a disk; the fourth has a copy."""

        def gather(self, mine: Any) -> list[Any]:
            shared = mine and isinstance(mine[0], tuple)
            return [mine, mine, mine, [(*file[:-1], -1) for file in mine]] if shared else [mine]

    read = [compare_shards(shards, tmp_path / f"{rank}.json", One(rank, 4), QUIET) for rank in range(3)]
    assert sum(read) == sum(shard.info.bytes for shard in shards) and min(read)
    assert compared == [["000000", "000003"], ["000001", "000004"], ["000002"]]


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


def test_a_run_hashes_shards_of_others_once_and_the_next_run_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shard_samples.write(tmp_path / "set", clips_per_shard=20)
    recipe = tmp_path / "x.yaml"
    recipe.write_text(RECIPE.replace("kind: synth, clips: 8", f"kind: shards, path: {tmp_path / 'set'}"))
    hashed: list[str] = []
    monkeypatch.setattr(checksums, "sha256_of", lambda path: (hashed.append(path.name), sha256_of(path))[1])
    for run in ("one", "another"):
        run_recipe(recipe, tmp_path / run, console=QUIET)
        assert sorted(hashed) == sorted(path.name for path in (tmp_path / "set").glob("*.tar"))


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
