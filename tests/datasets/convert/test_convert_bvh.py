"""BVH conversion: real clips, broken inputs, and bytes that no worker count changes."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from bvh_clips import unpack_bandai
from shard_samples import digests

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Manifest, Split
from motionloom.datasets.convert.bvh.config import BvhClip
from motionloom.datasets.convert.bvh.convert import Bvh, BvhConfig
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.common.facts import parse_where, require_known
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.convert.sets.amass import AmassConfig
from motionloom.datasets.motion.features.codec import decode
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.index import ClipEntry, ShardIndex, index_path
from motionloom.datasets.shards.reader import ShardDataset


@pytest.fixture(scope="module")
def clips(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of seven real clips (one of 0.67 s) with their lines of captions.jsonl."""
    folder = tmp_path_factory.mktemp("clips")
    (folder / "dataset-1").mkdir()
    wanted = {f"dataset-1/{path.name}" for path in unpack_bandai(shared, folder / "dataset-1").values()}
    lines = (shared / "data/bandai/captions.jsonl").read_text().splitlines()
    kept = [line for line in lines if json.loads(line)["file"] in wanted]
    (folder / "captions.jsonl").write_text("\n".join(kept))
    shutil.copy(shared / "data/bandai/joint_map.json", folder)
    return folder


@pytest.fixture
def copy(clips: Path, tmp_path: Path) -> Path:
    """The same, free to change."""
    return Path(shutil.copytree(clips, tmp_path / "source"))


def config(folder: Path, **changes: Any) -> BvhConfig:
    given: dict[str, Any] = {
        "source": folder,
        "joint_map": folder / "joint_map.json",
        "captions": folder / "captions.jsonl",
        "name": "bandai",
        "licence": "CC-BY-NC-4.0",
    }
    return BvhConfig(**(given | changes))


def convert(given: BvhConfig, out: Path, *, workers: int = 1, **options: Any) -> Manifest:
    prepared = prepare(given, workers=workers, out=out)
    return run_conversion(prepared, out, workers=workers, progress=False, **options)


def reasons(manifest: Manifest) -> dict[str, str]:
    return {drop.source.rsplit("/", 1)[-1]: drop.reason for drop in manifest.dropped}


def clip_file(folder: Path, name: str) -> Path:
    return folder / "dataset-1" / f"dataset-1_{name}_001.bvh"


def test_clips_become_samples_with_captions_split_and_licence(clips: Path, tmp_path: Path) -> None:
    manifest = convert(config(clips), tmp_path / "out")
    assert manifest.licence == "CC-BY-NC-4.0"
    assert (manifest.layout, manifest.family, manifest.fps) == ("body133", "exact", 20.0)
    ((short, reason),) = reasons(manifest).items()
    assert short == "dataset-1_dash_normal_001.bvh" and reason.startswith("0.67 s")
    assert {s.split: s.samples for s in manifest.shards} == {"train": 3, "val": 1, "test": 2}
    assert {s.split: s.frames for s in manifest.shards} == prepare(config(clips)).plan.totals.frames
    assert str(clips) not in json.dumps(manifest.dump())
    assert [p.name for p in (tmp_path / "out").iterdir() if p.name.startswith(".")] == []
    rows = {row["id"]: row for row in map(json.loads, (clips / "captions.jsonl").read_text().splitlines())}
    splits: tuple[Split, ...] = ("train", "val", "test")
    for split in splits:
        dataset = ShardDataset.open(tmp_path / "out", split)
        for i, clip_id in enumerate(dataset.ids):
            row = rows[clip_id]
            assert row["split"] == split
            assert [c.text for c in dataset.texts(i)] == row["captions"]
            meta = dataset.meta(i)
            assert (meta.source, meta.licence, meta.has_hands) == (row["file"], "CC-BY-NC-4.0", False)
            assert abs(len(dataset.motion(i)) - row["frames"] * 20 / 30) < 1.5


def test_ten_files_later_only_what_changed_is_converted(
    copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = config(copy, uncaptioned="keep")
    convert(given, tmp_path / "out", clips_per_shard=3)
    shutil.copy(clip_file(copy, "bow_angry"), copy / "new.bvh")
    with (copy / "new.bvh").open("a") as file:
        file.write("\n")
    clip_file(copy, "bow_giant").unlink()
    captions = copy / "captions.jsonl"
    captions.write_text(captions.read_text().replace("a person", "somebody", 1))
    real, encoded, said = Bvh.encode, list[str](), list[str]()

    def counted(self: Bvh, clip: BvhClip, joints: Any) -> Any:
        encoded.append(clip.label())
        return real(self, clip, joints)

    monkeypatch.setattr(Bvh, "encode", counted)
    manifest = run_conversion(
        prepare(given, out=tmp_path / "out"), tmp_path / "out", clips_per_shard=3, progress=False,
        say=said.append,
    )  # fmt: skip
    assert "new.bvh" in encoded and len(encoded) == 2, "the new clip, and the one whose caption changed"
    assert said[0].endswith("1 changed, 1 gone") and "1 new" in said[0]
    convert(given, tmp_path / "fresh", clips_per_shard=3)
    assert digests(tmp_path / "out") == digests(tmp_path / "fresh")
    assert "new" in {clip.id for shard in manifest.shards for clip in entries(tmp_path / "out", shard.name)}


def test_captions_of_other_times_than_the_clips_are_noted_and_left_out(copy: Path) -> None:
    name = clip_file(copy, "bow_angry").relative_to(copy)
    lines = [f"{name},a person bows,0,1e9", f"{name},a person runs,500,501", f"{name},a person nods,0,1"]
    (copy / "words.csv").write_text("\n".join(["file,caption,start,end", *lines]))
    plan = prepare(config(copy, captions=copy / "words.csv", uncaptioned="keep")).plan
    said = {clip.id: [text.text for text in clip.texts] for _, clip in plan.items}
    assert [texts for texts in said.values() if texts] == [["a person nods"]]
    assert sum(", beyond its" in note for note in plan.notes) == 2


def entries(out: Path, shard: str) -> list[ClipEntry]:
    return ShardIndex.load_json(index_path(out / shard)).clips


def test_plan_tells_missing_uncaptioned_duplicates_and_counts(copy: Path) -> None:
    shutil.copy(clip_file(copy, "bow_angry"), copy / "again.bvh")
    extra = clip_file(copy, "bow_giant").read_text() + "\n"
    (copy / "unknown.bvh").write_text(extra)
    clip_file(copy, "bow_active").unlink()
    (copy / "notes.txt").touch()
    plan = prepare(config(copy)).plan
    assert plan.totals.found == 8
    assert plan.counts() == {"train": 3, "val": 1, "test": 1}
    assert plan.totals.frames["val"] == 65
    assert [d.source for d in plan.missing] == ["dataset-1/dataset-1_bow_active_001.bvh"]
    assert plan.words.uncaptioned == ["again.bvh", "unknown.bvh"]
    told = Counter(d.reason.split(",")[0] for d in plan.dropped)
    assert told == {
        "same bytes as dataset-1/dataset-1_bow_angry_001.bvh": 1,
        "no usable caption": 1,
        "0.67 s": 1,
    }
    assert "8" in {str(cell) for column in plan.table().columns for cell in column.cells}
    kept = prepare(config(copy, captions=None)).plan
    assert any("same bytes as" in d.reason for d in kept.dropped)


def test_retarget_limit_and_empty_sources(copy: Path, tmp_path: Path) -> None:
    layout = MotionLayout.named("body133")
    convert(config(copy, retarget=True, limit=2), tmp_path / "out")
    total = 0
    for split in ("train", "val", "test"):
        if not list((tmp_path / "out").glob(f"*-{split}-*.tar")):
            continue
        dataset = ShardDataset.open(tmp_path / "out", split)  # type: ignore[arg-type]
        total += len(dataset)
        joints = decode(np.array(dataset.motion(0)), layout)
        shin = np.linalg.norm(joints[:, 7] - joints[:, 4], axis=-1)
        np.testing.assert_allclose(shin, np.linalg.norm(layout.skeleton.offsets[7]), atol=1e-3)
    assert total == 2
    (tmp_path / "nothing").mkdir()
    with pytest.raises(UserError, match=r"no \.bvh .*file"):
        prepare(config(copy, source=tmp_path / "nothing"))
    with pytest.raises(UserError, match="no such file"):
        prepare(config(copy, source=tmp_path / "none"))


# `where`: what an expression chooses, and what is said of one that cannot be read.

FACTS: dict[str, Any] = {
    "category": "Dance and Music", "seconds": 12.5, "is_mirror": "False", "task": ("text", "dance"),
    "age": "31",
}  # fmt: skip


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("", True),
        ("seconds<30", True),
        ("seconds <= 12.5 and seconds >= 12.5", True),
        ("seconds>12.5", False),
        ("age=31.0", True),
        ("age<9", False),  # by number, not by letter
        ("category=dance AND music AND seconds<30", True),
        ("category='dance and music' and seconds<30", True),
        ('category!="dance and music"', False),
        ("is_mirror=false", True),
        ("task=dance and task!=walk", True),
        ("category<3", False),
        ("unknown=1", False),
    ],
)
def test_conditions(text: str, holds: bool) -> None:
    assert all(condition.holds(FACTS) for condition in parse_where(text)) == holds


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("seconds", "'seconds' is no condition"),
        ("seconds<", "'seconds<' is no condition"),
        ("seconds<30 or age=3", "is no condition"),
        ("seconds<30 and", "'' is no condition"),
        ("__import__('os')", "is no condition"),
        ("a=1 and b==2", "'b==2' is no condition"),
        ("a=1 b=2", "is no condition"),
    ],
)
def test_what_cannot_be_read_is_quoted(text: str, said: str) -> None:
    with pytest.raises(UserError, match=said.replace("(", r"\(")):
        parse_where(text)


def test_every_source_has_it_and_unknown_names_are_answered_with_those_there_are(
    amass: ModuleType, tmp_path: Any
) -> None:
    for name, seconds in (("long", 3.0), ("short", 2.0)):
        amass.save(tmp_path / f"in/CMU/01/{name}_poses.npz", **amass.walk(60.0, seconds))
    plan = prepare(AmassConfig(source=tmp_path / "in", where="subset=cmu and seconds>2.5")).plan
    assert [clip.id for _, clip in plan.items] == ["CMU/01/long_poses"]
    assert ["seconds>2.5" in drop.reason for drop in plan.dropped] == [True]
    with pytest.raises(UserError, match="where: 'seconds'"):
        AmassConfig.parse({"source": str(tmp_path), "where": "seconds"}, "options")
    with pytest.raises(UserError, match=r"'sceonds'.* category, seconds"):
        require_known("sceonds<3", ["seconds", "category"])
