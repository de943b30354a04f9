"""Clips taken out of a data set for good: no name is left, others are untouched, killed and made again."""

from __future__ import annotations

import random
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bvh_clips import write_clip, write_map
from numpy.typing import NDArray
from typer.testing import CliRunner

from motionloom.datasets.check.dataset import check
from motionloom.datasets.convert.bvh.plan import BvhConfig
from motionloom.datasets.convert.common import removed
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.common.removed import Removed, remove
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.schema import REMOVED_FILE, Decisions, Manifest, Split, UserError
from motionloom.datasets.shards import finish, tasks
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.pipeline.cli.main import app

PEOPLE = ("anna", "bert", "carla", "dora")
SPLITS: tuple[Split, ...] = ("train", "val", "test")


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    for seed in range(20):
        path = folder / PEOPLE[seed % 4] / f"take{seed:02}.bvh"
        path.parent.mkdir(exist_ok=True)
        write_clip(path, seed, frames=36)
    (folder / "anna/short.bvh").write_text((folder / "anna/take00.bvh").read_text()[:-400])
    write_map(folder / "map.json")
    return folder


def convert(source: Path, out: Path) -> tuple[Manifest, list[str]]:
    said: list[str] = []
    config = BvhConfig(source=source, joint_map=source / "map.json", licence="CC0", splits=Path("clips:3"))
    prepared = prepare(config, out=out)
    manifest = run_conversion(prepared, out, clips_per_shard=4, progress=False, say=said.append)
    return manifest, [*prepared.plan.notes, *said]


@pytest.fixture(scope="module")
def made(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "out"
    convert(source, out)
    return out


def clips_in(out: Path) -> dict[str, NDArray[np.float32]]:
    held = {shard.split for shard in Manifest.load_json(out / "manifest.json").shards}
    found = {}
    for split in held:
        dataset = ShardDataset.open(out, split)
        found |= {name: np.array(dataset.motion(clip)) for clip, name in enumerate(dataset.ids)}
    return found


def content(folder: Path) -> dict[str, bytes]:
    """Files of a set without the record, whose salt is random, and what converters remember."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in files if path.name != REMOVED_FILE
    }


def test_a_person_leaves(source: Path, made: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(made, tmp_path / "out"))
    (out / "report.html").write_text("anna")
    (out / "cleaned.json").write_text(
        '{"left_out": {"anna/take00": "odd"}, "kept": ["anna/take04", "bert/take01"]}'
    )
    before, everyone = {path: path.stat().st_mtime_ns for path in out.glob("*.tar")}, clips_in(made)
    held = {path for path in before if b"anna/" in path.read_bytes()}
    assert 0 < len(held) < len(before)
    ran = CliRunner().invoke(app, ["data", "remove", str(out), "--subject", "anna"])
    assert ran.exit_code == 0 and f"5 clips removed; {len(held)} shards written" in ran.output
    assert {path for path in before if not path.exists() or path.stat().st_mtime_ns != before[path]} == held
    assert not [name for name, data in content(out).items() if b"anna" in data], "nobody is named"
    assert Decisions.of(out).kept == ("bert/take01",)
    left = clips_in(out)
    assert left.keys() == {name for name in everyone if "anna" not in name} and not check(out)
    for name, motion in left.items():
        np.testing.assert_array_equal(motion, everyone[name])
    assert sum(Manifest.load_json(out / "manifest.json").licences.values()) == 21 - 5  # of planned clips
    shards = {path: path.read_bytes() for path in out.glob("*.tar")}
    _, said = convert(source, out)
    assert any("6 clips stay out" in line for line in said), "one of them could not be converted"
    assert shards == {path: path.read_bytes() for path in out.glob("*.tar")}
    assert clips_in(out).keys() == left.keys() and not check(out)
    shutil.copytree(source, tmp_path / "moved")
    (tmp_path / "moved/anna/take00.bvh").rename(tmp_path / "moved/anna/other.bvh")
    assert len(clips_in(out)) == 15 and convert(tmp_path / "moved", out)
    assert clips_in(out).keys() == left.keys(), "the subject stays out, not its files alone"
    (out / REMOVED_FILE).unlink()
    convert(source, out)
    assert content(out).keys() >= content(made).keys() and clips_in(out).keys() == everyone.keys()


def test_single_clips_and_their_mirror_images(source: Path, made: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(made, tmp_path / "out"))
    for wrong, said in (({"ids": ["bert/tak01"]}, "bert/take01"), ({"subjects": ["bart"]}, "'bert'")):
        with pytest.raises(UserError, match=said):
            remove(out, **wrong)
    with pytest.raises(UserError, match="--subject NAME or --id ID"):
        remove(out)
    with pytest.raises(UserError, match="nothing would be left"):
        remove(out, subjects=PEOPLE)
    assert content(out) == content(made)
    assert remove(out, ids=["bert/take01"]).clips == 1
    shards = {path: path.stat().st_mtime_ns for path in out.glob("*.tar")}
    _, said = convert(source, out)
    assert any("nothing to convert" in line for line in said)
    assert shards == {path: path.stat().st_mtime_ns for path in out.glob("*.tar")}, "every shard is kept"
    assert remove(out, ids=["bert/take01", "dora/take03"], subjects=["carla"]).clips == 6
    assert len(clips_in(out)) == 13 and not check(out)
    record = Removed.of(out)
    assert record.has("Mx", "dora/take03.bvh") and not record.has("dora/take07", "dora/take07.bvh")
    assert Removed(salt="x").and_more(["id h/007"]).has("h/M007", "h/M007.npy")


@pytest.mark.parametrize("seed", range(4))
def test_a_damaged_shard_is_not_written_again(seed: int, made: Path, tmp_path: Path) -> None:
    draw, out = random.Random(seed), Path(shutil.copytree(made, tmp_path / "out"))
    held = [path for path in sorted(out.glob("*.tar")) if b"anna/" in path.read_bytes()]
    damaged = draw.choice(held)
    raw = bytearray(damaged.read_bytes())
    raw[draw.randrange(len(raw))] ^= 1 << draw.randrange(8)
    damaged.write_bytes(raw)
    before = content(out)
    with pytest.raises(UserError, match=rf"{damaged.name}: .*sha256"):
        remove(out, subjects=["anna"])
    assert content(out) == before and not (out / REMOVED_FILE).exists()


class KilledError(BaseException):
    """Stands for a kill."""


@pytest.mark.parametrize("seed", range(12))
def test_killed_anywhere_it_is_given_again(
    seed: int, source: Path, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At any step that changes the folder; then the same command, or a conversion, ends as it would have."""
    draw = random.Random(seed)
    given: dict[str, Any] = {"subjects": draw.sample(PEOPLE, draw.randint(1, 2)), "ids": ["dora/take03"]}
    expected, out = Path(shutil.copytree(made, tmp_path / "a")), Path(shutil.copytree(made, tmp_path / "b"))
    remove(expected, **given)
    steps = 0

    def counted(function: Any, stop: int) -> Any:
        def call(*args: Any, **options: Any) -> Any:
            nonlocal steps
            steps += 1
            if steps == stop:
                raise KilledError
            return function(*args, **options)

        return call

    patches: list[tuple[Any, str]] = [(Path, "replace"), (Path, "unlink"), (shutil, "rmtree")]
    patches += [(place, "write_json") for place in (removed, finish, tasks)] + [(removed, "write_shard")]
    for _ in range(4):
        with monkeypatch.context() as patched, pytest.raises(KilledError):
            steps, stop = 0, draw.randint(1, 25)
            for place, name in patches:
                patched.setattr(place, name, counted(getattr(place, name), stop))
            remove(out, **given)
            raise KilledError
        if (out / "manifest.json").exists():
            assert clips_in(out).keys() in (clips_in(made).keys(), clips_in(expected).keys()) and not check(
                out
            )
    if draw.random() < 0.5:
        remove(out, **given)
        assert content(out) == content(expected)
    else:
        convert(source, out)
        remove(out, **given)
    assert clips_in(out).keys() == clips_in(expected).keys() and not check(out)
    assert not (out / ".old").exists()
