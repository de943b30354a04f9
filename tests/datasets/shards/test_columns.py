"""Columns that are added beside the shards: read as if always there, and no shard is rewritten."""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import signal
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import SPLITS
from motionloom.datasets.check.dataset import examine
from motionloom.datasets.convert.common.removed import remove
from motionloom.datasets.shards.copy import copy_dataset
from motionloom.datasets.shards.reader import ShardDataset, load_manifest
from motionloom.datasets.shards.store import LocalStore
from motionloom.pipeline.cli.main import app
from motionloom.pipeline.curation import add_command as columns
from motionloom.pipeline.curation.add_command import add, remove_column
from motionloom.pipeline.stages.data.data import ShardsStageConfig


@pytest.fixture
def data(made: ModuleType, tmp_path: Path) -> Path:
    made.write(tmp_path / "data")
    return tmp_path / "data"


@pytest.fixture
def sources(tmp_path: Path) -> tuple[Path, Path]:
    """Captions of every third clip and of one that is gone, and an array for every other clip."""
    lines = [{"id": f"clip-ä-{i}", "captions": [f"more of {i}"]} for i in (*range(0, 60, 3), 999)]
    captions = tmp_path / "Colours 2.jsonl"
    captions.write_text("".join(json.dumps(line) + "\n" for line in lines))
    contacts = tmp_path / "contacts"
    contacts.mkdir()
    for i in range(0, 60, 2):
        np.save(contacts / f"clip-ä-{i}.npy", np.full((5, 4), i, np.float64))
    return captions, contacts


def held(place: Path | str) -> dict[str, tuple[list[str], Any]]:
    """Clip -> its captions, and its contacts, of all splits."""
    found = {}
    for split in SPLITS:
        clips = pickle.loads(pickle.dumps(ShardDataset.open(place, split)))
        assert [bool(clips.texts(i)) for i in range(len(clips))] == clips.has("texts.json").tolist()
        for i, name in enumerate(clips.ids):
            values = clips.array(i, "contacts.npy")
            assert (values is not None) == clips.has("contacts.npy")[i]
            found[name] = [one.text for one in clips.texts(i)], values
    return found


def fingerprint(place: Path) -> object:
    config = ShardsStageConfig.parse({"path": str(place)}, "data")
    return config.manifest()[1]


def test_two_columns_are_read_checked_copied_and_removed(
    data: Path, sources: tuple[Path, Path], made: ModuleType, tmp_path: Path
) -> None:
    before, plain, shards = held(data), fingerprint(data), made.digests(data)
    ran = CliRunner().invoke(app, ["data", "add", str(data), str(sources[0])])
    assert "no clip of the set: clip-ä-999" in ran.output and "for 20 of 60 clips" in ran.output, ran.output
    added = add(str(data), sources[1])
    assert (added.column.clips, added.gone, added.bad) == (30, [], [])
    after = held(data)
    for i in range(60):
        texts, values = after[f"clip-ä-{i}"]
        assert texts == before[f"clip-ä-{i}"][0] + [f"more of {i}"] * (i % 3 == 0)
        assert (values is None) if i % 2 else np.array_equal(values, np.full((5, 4), i, np.float32))
    now = made.digests(data)
    assert {name for name in shards if now[name] != shards[name]} == {"manifest.json"}, "nothing is rewritten"
    assert fingerprint(data) != plain
    report = examine(data)
    assert not report.errors and report.warning_kinds["column"] == 1, "one value is of no clip"
    there = tmp_path / "there"
    copy_dataset(str(data), str(there))
    assert held(there).keys() == after.keys() and not examine(there).errors
    with pytest.raises(UserError, match="has a column 'contacts'"):
        add(str(data), sources[1])
    tar = data / "columns" / "contacts" / "made-val-000000.tar"
    tar.write_bytes(bytes([tar.read_bytes()[0] ^ 1]) + tar.read_bytes()[1:])
    assert examine(data).error_kinds == {"column": 1}
    for name in ("contacts", "colours_2"):
        assert CliRunner().invoke(app, ["data", "add", str(data), name, "--remove"]).exit_code == 0
    assert {name: digest for name, digest in made.digests(data).items() if name[0] != "."} == shards
    copy_dataset(str(data), str(there))
    assert {name: it for name, it in made.digests(there).items() if name[0] != "."} == shards


def test_columns_follow_their_clips(data: Path, sources: tuple[Path, Path], made: ModuleType) -> None:
    for source in sources:
        add(str(data), source)
    before = held(data)
    lines = {path: path.read_bytes() for path in data.rglob("*.tar") if b"more of 30" in path.read_bytes()}
    remove(data, ids=["clip-ä-30"])
    del before["clip-ä-30"]
    assert lines and not any(b"more of 30" in path.read_bytes() for path in data.rglob("*.tar"))
    assert str(held(data)) == str(before) and not examine(data).errors
    assert {one.name: one.gone for one in load_manifest(data).columns} == {"colours_2": 2, "contacts": 1}


def change(what: str, data: Path, source: Path, left: int) -> None:
    """Add a column, or remove a clip; the process is killed before it puts another file than so many."""
    put = LocalStore.put
    puts = iter(range(left))

    def killed(self: LocalStore, path: Path, name: str, sha256: str) -> None:
        if next(puts, None) is None:
            os.kill(os.getpid(), signal.SIGKILL)
        put(self, path, name, sha256)

    LocalStore.put = killed  # type: ignore[method-assign]
    if what == "add":
        add(str(data), source)
    else:
        remove(data, ids=["clip-ä-30"])


@pytest.mark.parametrize("what", ["add", "remove"])
def test_killed_anywhere_and_given_again(
    what: str, sources: tuple[Path, Path], made: ModuleType, tmp_path: Path
) -> None:
    """A kill before each of the files that a column is put by; the same command then gives the same bytes."""
    whole: dict[str, str] = {}
    for left in (99, *range(10)):
        data = tmp_path / f"{what}{left}"
        made.write(data)
        if what == "remove":
            (data / "removed.json").write_text(json.dumps({"salt": "s", "hashes": []}))
            add(str(data), sources[0])
        for puts in dict.fromkeys((left, 99)):
            process = multiprocessing.get_context("fork").Process(
                target=change, args=(what, data, sources[0], puts)
            )
            process.start()
            process.join()
            assert process.exitcode == (0 if puts == 99 else -signal.SIGKILL)
        whole = whole or made.digests(data)
        assert made.digests(data) == whole, left


def test_two_people_add_columns_to_a_bucket_at_once(
    data: Path,
    sources: tuple[Path, Path],
    loopback: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "empty").mkdir()
    with loopback.bucket(tmp_path / "empty", every=0) as (environment, _):
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        place = "s3://shards/set"
        copy_dataset(str(data), place)
        write = columns.write_stored
        others = iter([sources[1]])

        def interrupted(store: Any, name: str, record: object) -> None:
            for source in others if name == "manifest.json" else ():
                add(place, source)  # whole, between what the first has read and what it writes
            write(store, name, record)

        monkeypatch.setattr(columns, "write_stored", interrupted)
        add(place, sources[0])
        for source in sources:
            add(str(data), source)
        assert str(held(place)) == str(held(data))
        remove_column(place, "contacts")
        assert not any(values is not None for _, values in held(place).values())
        with pytest.raises(UserError, match="known: colours_2"):
            remove_column(place, "contacts")
