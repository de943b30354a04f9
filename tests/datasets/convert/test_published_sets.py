"""Sets read by their published layouts: tiny trees give the walk they were made from, damage is named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import release_trees as trees
from amass_clips import expected_joints, features, meta_of, reasons

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Manifest
from motionloom.datasets.check.dataset import check
from motionloom.datasets.convert.common.conversion import Conversion, run_conversion
from motionloom.datasets.convert.registry import converter_named, prepare
from motionloom.datasets.convert.sets.motion272 import joints_of_272
from motionloom.datasets.convert.sets.snapmogen import ORDER, joints_of_296
from motionloom.datasets.motion.canonical import canonicalize
from motionloom.datasets.motion.features.codec import decode
from motionloom.datasets.motion.layout import MotionLayout

QUICK = {"audio_features": False, "sound_rate": 8000}
"""Without the 438 features, whose first use compiles for half a minute."""

SETS: dict[str, dict[str, Any]] = {
    "motionhub": {"clip": "HumanML3D_AMASS/000/000001", "layout": "wholebody313", "more": QUICK, "found": 4},
    "finedance": {"clip": "001", "layout": "wholebody313", "more": QUICK, "found": 3},
    "bones_seed": {"clip": "walk_001__A1", "layout": "wholebody313", "more": {}, "found": 3},
    "motion272": {"clip": "000000", "layout": "body133", "more": {}, "found": 3},
    "snapmogen": {"clip": "m_ep2_00086#0#90", "layout": "body133", "more": {}, "found": 2},
    "beat2": {
        "clip": "beat_english_v2.0.0/2_scott_0_1_1",
        "layout": "wholebody363",
        "more": QUICK,
        "found": 2,
    },
    "style100": {"clip": "ArmsAboveHead_FW", "layout": "body133", "more": {}, "found": 3},
}


def planned(name: str, source: Path, **options: Any) -> Conversion[Any]:
    given = {"source": source, "fps": 30.0, "layout": SETS[name]["layout"], **SETS[name]["more"], **options}
    return prepare(converter_named(name).config_class.parse(given, name))


def make(name: str, source: Path, out: Path, **options: Any) -> Manifest:
    return run_conversion(planned(name, source, **options), out, progress=False)


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
    found = [note for note in conversion.plan.notes if f"; found here: {case['found']} clips" in note]
    assert len(found) == (name != "motion272")  # whose numbers are those of another tree
    manifest = make(name, built(name), tmp_path / "out")
    assert set(found) <= set(manifest.notes) and manifest.licence
    assert check(tmp_path / "out") == []
    layout = MotionLayout.named(case["layout"], fps=30.0)
    motion = features(tmp_path / "out")[case["clip"]]
    joints = decode(motion[:, layout.part("bodyhand")], layout.without_face())
    wanted = expected_joints(30.0, joints=layout.num_joints)[: len(joints)]
    assert len(joints) >= 89
    # BVH is made at 60 or 120 fps by interpolating angles; the four spine joints of Xsens are not our three.
    limbs = [number for number in range(22) if number not in (3, 6, 9)] if name == "style100" else slice(None)
    np.testing.assert_allclose(joints[:, limbs], wanted[:, limbs], atol=5e-4)
    assert meta_of(tmp_path / "out", case["clip"])[0].has_hands == (layout.num_joints > 22)


def test_motionhub_joins_what_its_lists_say_of_a_motion(built: Callable[[str], Path], tmp_path: Path) -> None:
    manifest = make("motionhub", built("motionhub"), tmp_path / "out", val_share=0.0)
    ((missing, reason),) = reasons(manifest).items()
    assert missing == "hi4d/smplh_52/gone.npz" and "'hi4d/gone'" in reason
    meta, texts = meta_of(tmp_path / "out", "aist/gBR_1")
    assert (meta.split, meta.song, meta.licence) == ("test", "aist/music/m.wav", "MotionHub, terms of aist")
    assert {text.source for text in texts} == {"macro", "meso"}
    mirrored = meta_of(tmp_path / "out", "HumanML3D_AMASS/M000/M000001")[0]
    assert mirrored.mirror_of == "HumanML3D_AMASS/000/000001"
    _, texts = meta_of(tmp_path / "out", "ted_db/talk")
    assert [text.text.split()[0] for text in texts if text.source == "speech"] == ["so"]
    some = planned("motionhub", built("motionhub"), subsets=["ted_db"]).plan
    assert [clip.id for _, clip in some.items] == ["ted_db/talk"] and not some.missing
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
        ("goes on", 1.5, 361 / 120),
    ]
    with pytest.raises(UserError, match=r"'categry'.* category, "):
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


def text(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")


def wide(path: Path, columns: int) -> None:
    np.save(path, np.zeros((90, columns), dtype=np.float32))


def test_vectors_are_turned_back_to_the_joints() -> None:
    """To rounding, whatever the frame rate: the encoders in the helpers go frame by frame."""
    wanted = expected_joints(30.0)
    for joints in (joints_of_272(trees.encode_272()), joints_of_296(trees.encode_296())[:, ORDER] * 0.018):
        found = canonicalize(joints)
        np.testing.assert_allclose(found, wanted[: len(found)], atol=1e-10)


def test_motionmillion_and_streams_have_other_trees(tmp_path: Path) -> None:
    for place, names in (("motion_data/vector_272", ("gv/a", "gv/b")), ("train_stream", ("seq1",))):
        for name in names:
            path = tmp_path / place.split("/")[0] / f"{place}/{name}.npy"
            path.parent.mkdir(parents=True, exist_ok=True)
            np.save(path, trees.encode_272())
    million, stream = tmp_path / "motion_data", tmp_path / "train_stream"
    trees.put(million / "texts/gv/a.txt", "a person walks\nsomeone walks\n")
    trees.put(million / "split/version1/t2m_60_300/train.txt", "gv/a\n")
    plan = planned("motion272", million).plan
    ((_, clip),) = plan.items
    assert [text.text for text in clip.entry.texts] == ["a person walks", "someone walks"]
    assert any("2,000,000 clips" in note and "found here: 2 clips" in note for note in plan.notes)
    assert {drop.source: drop.reason for drop in plan.dropped} == {
        "motion_data/vector_272/gv/b.npy": "in no split file"
    }
    trees.put(stream / "train_stream_text/seq1.txt", "stands*walks off#45")
    ((split, clip),) = planned("motion272", stream).plan.items
    assert split == "train"
    assert [(text.text, text.start, text.end) for text in clip.entry.texts] == [
        ("stands", 0.0, 1.5),
        ("walks off", 1.5, None),
    ]


def test_beat2_keeps_face_and_what_is_said(built: Callable[[str], Path], tmp_path: Path) -> None:
    make("beat2", built("beat2"), tmp_path / "out")
    clip = "beat_english_v2.0.0/2_scott_0_1_1"
    meta, texts = meta_of(tmp_path / "out", clip)
    assert meta.has_face and meta.split == "test"
    assert [(text.text, text.start, text.end) for text in texts] == [
        ("hello there", 0.2, 1.0),
        ("friend", 2.0, 2.5),
    ]
    face = features(tmp_path / "out")[clip][:, MotionLayout.named("wholebody363").slice("face")]
    wanted = np.linspace(-1, 1, 91)[:, None] * np.linspace(0.1, 1, 100)[:50]
    np.testing.assert_allclose(face, wanted[: len(face)], atol=1e-6)
    plan = planned(
        "beat2", built("beat2"), where="speaker=2_scott and type!=additional", sound="require"
    ).plan
    assert [one.id for _, one in plan.items] == [clip]


def test_speech_that_goes_on_after_the_motion_is_said(shared: Path) -> None:
    notes = planned("beat2", shared / "data/reports/data/beat2-longer-speech").plan.notes
    assert any("the sound of 1 clips goes on after the motion, 14.0 s at most" in note for note in notes)


def test_snapmogen_and_styles_are_cut(built: Callable[[str], Path]) -> None:
    clips = {clip.id: clip for _, clip in planned("snapmogen", built("snapmogen")).plan.items}
    assert {clip.last - clip.first for clip in clips.values()} == {90, 50}
    assert {text.source for text in clips["m_ep2_00086#30#80"].entry.texts} == {"manual", "gpt"}
    plan = planned("style100", built("style100"), where="style=Old").plan
    ((_, clip),) = plan.items
    assert (clip.frames, clip.fps) == (181, 60.0)
    assert [text.text[-13:] for text in clip.texts] == ["the style old", "Slow and bent"]
    uncut, other = sorted(drop.reason for drop in plan.dropped)
    assert "Frame_Cuts.csv" in uncut and other == "not where style=Old"


HML = "HumanML3D_AMASS/smplh_52/000/000001.npz"
LIST = "annotations/text_motion/train.json"
META, LABELS = "metadata/seed_metadata_v004.csv", "metadata/seed_metadata_v002_temporal_labels.jsonl"
DANCE = "motion/001.npy"
VECTORS, SAID = "motion_data/000000.npy", "all_caption_clean.json"
CUTS, BEAT = "Frame_Cuts.csv", "beat_english_v2.0.0"
TALK, GRID = f"{BEAT}/smplxflame_30/2_scott_0_1_1.npz", f"{BEAT}/textgrid/2_scott_0_1_1.TextGrid"

DAMAGE: list[tuple[str, Callable[[Path], object], str]] = [
    ("motionhub", lambda root: nan_at(root / HML, "poses"), f"{HML}: poses: nan at frame 5, column 1"),
    ("motionhub", lambda root: text(root / LIST, "aist/s", "../s"), "not a plain relative"),
    ("finedance", lambda root: wide(root / DANCE, 319), f"{DANCE}: expected [T, 315], found [90, 319]"),
    ("finedance", lambda root: wide(root / DANCE, 315), f"{DANCE}: no rotation at frame 0, joint 0"),
    ("bones_seed", lambda root: text(root / META, "actor_uid", "actor"), "no column 'actor_uid'"),
    ("bones_seed", lambda root: text(root / LABELS, "end_time", "end"), "needs filename, and events with"),
    ("motion272", lambda root: wide(root / VECTORS, 263), f"{VECTORS}: expected [T, 272], found [90, 263]"),
    ("snapmogen", lambda root: text(root / SAID, "gone#0#90", "gone"), "a clip is named NAME#FIRST#LAST"),
    ("snapmogen", lambda root: text(root / SAID, '"gone#0#90": {', '"gone#0#90": [{}], "x#0#9": {'),
     "'gone#0#90': a JSON object is expected"),
    ("beat2", lambda root: nan_at(root / TALK, "expressions"), "expressions: nan at frame 5, column 1"),
    ("beat2", lambda root: text(root / GRID, '"words"', '"letters"'), f'{GRID}: no tier "words" in it'),
    ("style100", lambda root: text(root / CUTS, "Old,40,221", "Old,999,1200"), "shorter than 1 s"),
    ("style100", lambda root: (root / CUTS).unlink(), "no Frame_Cuts.csv in it"),
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


BAD_ROWS: dict[str, tuple[str, str, str, str]] = {
    "bones_seed": (
        META,
        "walk_001__A1_M,walk_001,361",
        "walk_001__A1_M,walk_001,long",
        "'long' is no number",
    ),
    "style100": (CUTS, "Old,40,221", "Old,40,1e99", "'1e99' is no number"),
    "beat2": (
        f"{BEAT}/train_test_split.csv",
        "2_scott_0_2_2,additional",
        "a,b,c",
        "3 columns, the header has 2",
    ),
    "snapmogen": (SAID, "m_ep2_00086#30#80", "m_ep2_00086#30#-80", "'-80' is no number"),
    "motionhub": (LIST, '"fps": 30.0}, "M000001"', '"fps": 30.0}, "bad": 7, "M000001"', "train.json: 'bad'"),
    "motion272": ("split/train.txt", "M000000", "../M000000", "../M000000"),
}


@pytest.mark.parametrize("name", BAD_ROWS)
def test_one_bad_row_of_a_sets_table_leaves_that_row_out(
    name: str, built: Callable[[str], Path], tmp_path: Path
) -> None:
    whole = {clip.id for _, clip in planned(name, built(name)).plan.items}
    source, (table, old, new, said) = getattr(trees, name)(tmp_path / "in"), BAD_ROWS[name]
    text(source / table, old, new)
    plan = planned(name, source).plan
    assert whole - {clip.id for _, clip in plan.items} <= {
        old.split(",")[0],
        "Old_FW",
        f"{BEAT}/2_scott_0_2_2",
    }
    told = [*plan.notes, *(f"{one.source}: {one.reason}" for one in plan.left_out())]
    assert any(said in one for one in told), told
