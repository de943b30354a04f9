"""Sets read by their published layouts: tiny trees give the walk they were made from, damage is named."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import release_trees as trees
from amass_clips import expected_joints, features, meta_of, reasons

from motionloom.datasets.check.dataset import check
from motionloom.datasets.convert.common.conversion import Conversion, run_conversion
from motionloom.datasets.convert.registry import converter_named, prepare
from motionloom.datasets.motion.features.codec import decode
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import Manifest, UserError

QUICK = {"audio_features": False, "sound_rate": 8000}
"""Without the 438 features, whose first use compiles for half a minute."""

SETS: dict[str, dict[str, Any]] = {
    "motionhub": {"clip": "HumanML3D_AMASS/000/000001", "layout": "wholebody313", "more": QUICK, "found": 3},
    "finedance": {"clip": "001", "layout": "wholebody313", "more": QUICK, "found": 3},
    "bones_seed": {"clip": "walk_001__A1", "layout": "wholebody313", "more": {}, "found": 3},
}


def planned(name: str, source: Path, **options: Any) -> Conversion[Any]:
    given = {"source": source, "fps": 30.0, "layout": SETS[name]["layout"], **SETS[name]["more"], **options}
    return prepare(converter_named(name).config_class.parse(given, name))


def make(name: str, source: Path, out: Path, workers: int = 1, **options: Any) -> Manifest:
    return run_conversion(planned(name, source, **options), out, workers=workers, progress=False)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The tree of a set, made once; tests that change it copy it."""
    root = tmp_path_factory.mktemp("trees")

    def tree(name: str) -> Path:
        folder = root / name
        return folder if folder.exists() else getattr(trees, name)(folder)

    return tree


@pytest.mark.parametrize("name", SETS)
def test_a_set_gives_the_walk_it_was_made_from(
    built: Callable[[str], Path], name: str, tmp_path: Path
) -> None:
    case = SETS[name]
    conversion = planned(name, built(name))
    assert conversion.plan.found == case["found"]
    rows = {row.what: row for row in conversion.plan.audit_rows()}
    assert rows["clips"].found == case["found"] and rows["clips"].stated > 200
    manifest = make(name, built(name), tmp_path / "out")
    assert manifest.audit == conversion.plan.audit_rows() and manifest.licence
    assert check(tmp_path / "out") == []
    layout = MotionLayout.named(case["layout"], fps=30.0)
    motion = features(tmp_path / "out")[case["clip"]]
    found = decode(motion, layout)
    wanted = expected_joints(30.0, joints=layout.num_joints)[: len(found)]
    assert len(found) >= 89
    # BVH at 120 fps is resampled, and stores nine digits; six columns are float32.
    np.testing.assert_allclose(found, wanted, atol=5e-4)
    assert meta_of(tmp_path / "out", case["clip"])[0].has_hands == (layout.num_joints > 22)


@pytest.mark.parametrize("name", ["motionhub"])  # BVH has the same test for itself
def test_two_workers_write_the_same_bytes(built: Callable[[str], Path], name: str, tmp_path: Path) -> None:
    for workers in (1, 2):
        make(name, built(name), tmp_path / str(workers), workers)
    for path in sorted((tmp_path / "1").glob("*.tar")):
        assert path.read_bytes() == (tmp_path / "2" / path.name).read_bytes()
    assert list((tmp_path / "1").glob("*.tar"))


def test_motionhub_joins_what_its_lists_say_of_a_motion(built: Callable[[str], Path], tmp_path: Path) -> None:
    manifest = make("motionhub", built("motionhub"), tmp_path / "out", val_share=0.0)
    assert reasons(manifest) == {
        "hi4d/smplh_52/gone.npz": "clip 'hi4d/gone' is listed, but its file is not in the source"
    }
    meta, texts = meta_of(tmp_path / "out", "aist/gBR_1")
    assert (meta.split, meta.song, meta.licence) == ("test", "aist/music/m.wav", "MotionHub, terms of aist")
    assert {text.source for text in texts} == {"macro", "meso"}
    _, texts = meta_of(tmp_path / "out", "ted_db/talk")
    assert [text.text for text in texts if text.source == "speech"] == ["so this is how we walk"]
    alone = planned("motionhub", built("motionhub"), tasks=["music_dance"], sound="require")
    assert [clip.id for _, clip in alone.plan.items] == ["aist/gBR_1"]


def test_finedance_for_music_and_by_the_authors_split(built: Callable[[str], Path], tmp_path: Path) -> None:
    plan = planned("finedance", built("finedance"), val_share=0.0).plan
    assert {clip.id: split for split, clip in plan.items} == {"001": "train", "063": "test"}
    plan = planned("finedance", built("finedance"), split="dancer", caption_genre=True, sound="require").plan
    assert [(split, clip.entry.texts[0].text) for split, clip in plan.items] == [
        ("test", "a dancer performs Breaking")
    ]
    left = {drop.source: drop.reason for drop in plan.dropped}
    assert "list of unusable dances" in left["motion/116.npy"]
    assert "no readable sound" in left["motion/063.npy"]
    make("finedance", built("finedance"), tmp_path / "out", layout="smpl75")
    assert features(tmp_path / "out")["001"].shape == (91, 75)


def test_seed_has_facts_timelines_and_splits_by_actor(built: Callable[[str], Path], tmp_path: Path) -> None:
    plan = planned("bones_seed", built("bones_seed"), where="category=dances and is_mirror=false").plan
    ((_, clip),) = plan.items
    assert clip.id == "walk_001__A1"
    assert [(text.text, text.start, text.end) for text in clip.texts if text.source == "timeline"] == [
        ("starts", 0.0, 1.5),
        ("goes on", 1.5, 3.0),
    ]
    with pytest.raises(UserError, match=r"no clip has 'categry'; known of clips: actor_uid, category, "):
        planned("bones_seed", built("bones_seed"), where="categry=Dances")
    splits = {clip.id: split for split, clip in planned("bones_seed", built("bones_seed")).plan.items}
    assert splits["walk_001__A1"] == splits["walk_001__A1_M"]


def nan_at(path: Path, key: str | None = None) -> None:
    """A value that is no number in a motion file."""
    if key is None:
        values = np.load(path)
        values[5, 9] = np.nan
        np.save(path, values)
        return
    arrays = dict(np.load(path))
    arrays[key] = arrays[key].astype(np.float64)
    arrays[key][5, 1] = np.nan
    np.savez(path, **arrays)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def text(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")


def wide(path: Path, columns: int) -> None:
    np.save(path, np.zeros((90, columns), dtype=np.float32))


HML = "HumanML3D_AMASS/smplh_52/000/000001.npz"
LIST = "annotations/text_motion/train.json"
META, LABELS = "metadata/seed_metadata_v004.csv", "metadata/seed_metadata_v002_temporal_labels.jsonl"
TAKE = "soma_uniform/bvh/240100/walk_001__A1.bvh"
DANCE = "motion/001.npy"

DAMAGE: list[tuple[str, Callable[[Path], object], str]] = [
    ("motionhub", lambda root: cut(root / HML), f"{HML}: not an .npz file, or cut off"),
    ("motionhub", lambda root: nan_at(root / HML, "poses"), f"{HML}: poses: nan at frame 5, column 1"),
    ("motionhub", lambda root: cut(root / LIST), f"{LIST}: not valid JSON"),
    ("motionhub", lambda root: text(root / LIST, "HumanML3D_AMASS/s", "../s"), "not a plain relative"),
    ("motionhub", lambda root: cut(root / "aist/music/m.wav"), "aist/music/m.wav"),
    ("finedance", lambda root: cut(root / DANCE), f"{DANCE}: truncated array"),
    ("finedance", lambda root: nan_at(root / DANCE), f"{DANCE}: nan at frame 5, column 9"),
    ("finedance", lambda root: wide(root / DANCE, 319), f"{DANCE}: expected [T, 315], found [90, 319]"),
    ("finedance", lambda root: wide(root / DANCE, 315), f"{DANCE}: no rotation at frame 0, joint 0"),
    ("finedance", lambda root: cut(root / "label_json/001.json"), "label_json/001.json: not valid JSON"),
    ("bones_seed", lambda root: text(root / META, "actor_uid", "actor"), "no column 'actor_uid'"),
    ("bones_seed", lambda root: text(root / META, ",A1,", ","), "6 columns, the header has 7"),
    ("bones_seed", lambda root: cut(root / LABELS), f"{Path(LABELS).name}:1: not valid JSON"),
    ("bones_seed", lambda root: text(root / LABELS, "end_time", "end"), "needs filename, and events with"),
    ("bones_seed", lambda root: cut(root / TAKE), "walk_001__A1.bvh"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "harm", "said"), DAMAGE, ids=[f"{d[0]}-{d[2][:30]}" for d in DAMAGE])
def test_damage_is_named_in_one_sentence(
    name: str, harm: Callable[[Path], object], said: str, tmp_path: Path
) -> None:
    source = getattr(trees, name)(tmp_path / "in")
    harm(source)
    try:
        left = make(name, source, tmp_path / "out", most_rejected=1.0).dropped
        sentences = [f"{drop.source}: {drop.reason}" for drop in left]
    except UserError as error:
        sentences = [str(error)]
    (sentence,) = [one for one in sentences if said in one]
    assert "\n" not in sentence


def test_a_damaged_json_says_nothing_of_this_machine(tmp_path: Path) -> None:
    source = trees.motionhub(tmp_path / "in")
    (source / "annotations/text_motion/train.json").write_text(json.dumps({"data_list": {"a": 3}}))
    with pytest.raises(UserError, match=r"train\.json: 'a': a JSON object is expected, found int"):
        planned("motionhub", source)
