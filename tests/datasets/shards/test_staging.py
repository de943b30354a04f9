"""Conversion in parts straight into a bucket: killed, repeated, doubled, the bytes are those of a folder."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import fsspec
import pytest
from bvh_clips import write_source
from typer.testing import CliRunner, Result

from motionloom.datasets.base.records import SPLITS
from motionloom.datasets.shards import store
from motionloom.datasets.shards.copy import copy_dataset
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.store import RemoteStore, open_store
from motionloom.pipeline.cli.main import app
from motionloom.pipeline.curation.add_command import add

PARTS = 3


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    source = write_source(tmp_path_factory.mktemp("source"), [f"walk-{i}" for i in range(12)])
    (source / "splits").mkdir()
    for first, split in enumerate(SPLITS):
        names = (f"walk-{i}\n" for i in range(first, 12, 3))
        (source / "splits" / f"{split}.txt").write_text("".join(names))
    return source


@pytest.fixture(params=["s3", "memory"])
def place(
    request: pytest.FixtureRequest, loopback: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[str]:
    """An empty bucket: of a server whose requests fail now and then, and fsspec's own in memory."""
    monkeypatch.setattr(store, "FIRST_PAUSE", 0.001)
    monkeypatch.setattr(store, "SCHEMES", (*store.SCHEMES, "memory"))
    fsspec.filesystem("memory").rm("/", recursive=True)
    (tmp_path / "empty").mkdir()
    with loopback.bucket(tmp_path / "empty", every=9) as (environment, _):
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        yield f"{request.param}://shards/{tmp_path.name}"


def convert(source: Path, out: object, *more: str) -> Result:
    sets = ("look=0", f"joint_map={source / 'map.json'}", f"splits={source / 'splits'}")
    words = ["data", "convert", "bvh", str(source), str(out), "--licence", "CC0", "--workers", "1", *more]
    return CliRunner().invoke(app, [*words, *(word for one in sets for word in ("--set", one))])


def made(place: str, folder: Path) -> dict[str, bytes]:
    """All files of a data set, which is complete."""
    copy_dataset(place, str(folder))
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name[0] != "."}


def test_parts_go_straight_into_a_bucket(source: Path, place: str, tmp_path: Path) -> None:
    assert convert(source, tmp_path / "whole").exit_code == 0
    whole = made(str(tmp_path / "whole"), tmp_path / "copy")
    join = ["data", "join", place]
    for part in (2, 1, 2):
        ran = convert(source, place, "--part", f"{part}/{PARTS}")
        assert ran.exit_code == 0 and f"motionloom data join {place}" in ran.output, ran.output
    with pytest.raises(Exception, match=rf"{place}: part 3/{PARTS} is missing"):
        CliRunner().invoke(app, join, catch_exceptions=False)
    assert convert(source, place, "--part", f"3/{PARTS}").exit_code == 0
    assert CliRunner().invoke(app, join).exit_code == CliRunner().invoke(app, join).exit_code == 0
    names = open_store(place).names("")
    assert made(place, tmp_path / "there") == whole and not [name for name in names if name[0] == "."]
    assert ShardDataset.open(place, "train").ids == ShardDataset.open(tmp_path / "whole", "train").ids
    captions = tmp_path / "said.jsonl"
    captions.write_text('{"id": "walk-0", "captions": ["walks"]}')
    add(place, captions)
    # All again, and in one command: nothing is sent, the column stays.
    again = convert(source, place)
    assert again.exit_code == 0 and "nothing to convert" in again.output
    assert "columns/said/column.json" in open_store(place).names("")
    assert ShardDataset.open(place, "train").manifest.columns
    # Another source: what is gone goes, and a column of other shards is listed no more.
    (source / "walk-0.bvh").rename(tmp_path / "walk-0.bvh")
    assert convert(source, place).exit_code == convert(source, tmp_path / "less").exit_code == 0
    (tmp_path / "walk-0.bvh").rename(source / "walk-0.bvh")
    assert made(place, tmp_path / "then") == made(str(tmp_path / "less"), tmp_path / "less-copy")


def part(source: Path, place: str, number: int, puts: int) -> None:
    """A part whose process is killed before it puts another file than so many."""
    put = RemoteStore.put
    left = iter(range(puts))

    def killed(self: RemoteStore, path: Path, name: str, sha256: str) -> None:
        if next(left, None) is None:
            os.kill(os.getpid(), signal.SIGKILL)
        put(self, path, name, sha256)

    RemoteStore.put = killed  # type: ignore[method-assign]
    os._exit(convert(source, place, "--part", f"{number}/{PARTS}").exit_code)


@pytest.mark.parametrize("place", ["s3"], indirect=True)
def test_parts_that_are_killed_and_doubled(source: Path, place: str, tmp_path: Path) -> None:
    """Each part is killed before each of its files; two machines make each part at once."""
    fork = multiprocessing.get_context("fork").Process
    ended: list[Any] = []
    for number in range(1, PARTS + 1):
        for puts in (0, 1, 2, 99):
            both = [fork(target=part, args=(source, place, number, puts)) for _ in range(2)]
            for process in both:
                process.start()
            for process in both:
                process.join()
                ended.append(process.exitcode)
    assert ended[6:8] == ended[14:16] == ended[22:24] == [0, 0] and ended[:2] == [-signal.SIGKILL] * 2
    assert CliRunner().invoke(app, ["data", "join", place]).exit_code == 0
    assert convert(source, tmp_path / "whole").exit_code == 0
    assert made(place, tmp_path / "there") == made(str(tmp_path / "whole"), tmp_path / "copy")
