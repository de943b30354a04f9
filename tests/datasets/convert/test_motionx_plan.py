"""Motion-X plans: every naming of the folders, texts of both grammars, splits, subsets and licences."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from motionx_clips import ALL, BOW, DANCE, HUMANML, MOTION, MUG, TEXTS, TURN, WAVE, clips_of, config, planned

from motionloom.datasets.convert.registry import prepare


@pytest.fixture
def fixture(shared: Path) -> Path:
    return shared / "data/layouts/motionx"


# Texts


def test_captions_of_both_grammars(fixture: Path) -> None:
    clips = planned(fixture)
    assert [c.text.split()[-1] for c in clips[BOW].texts] == ["happily.", "bow."]
    assert clips[DANCE].texts[0].text == "Dance Krump Stomp"
    texts = clips[HUMANML].texts
    # The third line's segment ends at 2.5 s; 50 frames are 1.67 s at 30 fps (they would be 2.5 s at 20).
    assert [c.text.split()[0] for c in texts] == ["an", "someone"]
    assert texts[0].tokens is not None
    assert texts[0].tokens[0] == "an/DET"
    assert {c.source for clip in clips.values() for c in clip.texts} == {"motionx"}
    assert [c.text for c in clips[BOW].face_texts] == ["happy"]
    assert clips[BOW].face_texts[0].source == "face"
    notes = prepare(config(fixture)).plan.notes
    assert any(HUMANML in note and "2.5 s" in note and "1.7 s" in note for note in notes)


def test_names_and_empty_captions(copy: Path) -> None:
    (copy / TEXTS / f"{WAVE}.txt").write_text("\ufeffDance_Break_Back_Cc_clip_2\r\n\r\n")
    (copy / TEXTS / f"{BOW}.txt").write_text("\n  \n")
    (copy / TEXTS / f"{TURN}.txt").write_bytes(b"caf\xe9 dance")
    (copy / TEXTS / f"{MUG}.txt").unlink()
    plan = prepare(config(copy)).plan
    clips = {clip.id: clip.entry for _, clip in plan.items}
    assert [c.text for c in clips[WAVE].texts] == ["Dance Break Back Cc"]
    assert {d.source for d in plan.dropped} == {f"{MOTION}/{i}.npy" for i in (BOW, TURN, MUG)}
    assert {d.reason for d in plan.dropped} == {"no usable caption"}
    assert set(plan.words.uncaptioned) == {d.source for d in plan.dropped}
    assert [d.source for d in plan.broken] == [f"{TEXTS}/{TURN}.txt"]
    assert "byte 3" in plan.broken[0].reason
    assert set(planned(copy, uncaptioned="keep")) == ALL


# Folders and ids


@pytest.mark.parametrize(
    ("moves", "notes"),
    [
        ({"texts/semantic_labels": "texts/semantic_texts"}, ["captions: texts/semantic_texts/ (8 files)"]),
        (
            {
                "texts/semantic_labels": "motionx_seq_text_v1.1",
                "texts/face_texts": "motionx_face_text",
                "motion_data/smplx_322": "motionx_smplx/smplx_322",
                "face_motion_data/smplx_322": "motionx_face_motion/smplx_322",
            },
            ["captions: motionx_seq_text_v1.1/", "face texts: motionx_face_text/", "motionx_smplx/"],
        ),
        ({"motion_data/smplx_322": "smplx_322"}, ["motion: smplx_322/ (8 files)"]),
        ({"motion_data/smplx_322": "motion/motion_generation/smplx322"}, ["motion_generation/smplx322/"]),
        (
            {"texts/semantic_labels/GRAB": "GRAB_txt", "texts/semantic_labels/humanml": "humanml_txt/texts"},
            ["GRAB_txt/ (1 files)"],
        ),
        ({"texts/semantic_labels/GRAB": "texts/semantic_labels/GRAB_text"}, []),
        ({"motion_data/smplx_322/GRAB": "GRAB_motion"}, ["GRAB_motion/ (1 files)"]),
        ({"train.txt": "split/train.txt", "val.txt": "split/val.txt", "test.txt": "split/test.txt"}, []),
    ],
)  # fmt: skip
def test_every_known_naming(copy: Path, fixture: Path, moves: dict[str, str], notes: list[str]) -> None:
    for old, new in moves.items():
        (copy / new).parent.mkdir(parents=True, exist_ok=True)
        (copy / old).rename(copy / new)
    plan = prepare(config(copy)).plan
    found, base = (
        {
            clip.id: (split, clip.entry.texts, clip.entry.face_texts, bool(clip.entry.face))
            for split, clip in each.items
        }
        for each in (plan, prepare(config(fixture)).plan)
    )
    assert found == base
    for note in notes:
        assert any(note in told for told in plan.notes), plan.notes


def test_other_representations_and_copies_are_not_motion(copy: Path) -> None:
    (copy / "motion_data/vector_623/idea400").mkdir(parents=True)
    np.save(copy / "motion_data/vector_623/idea400/a.npy", np.zeros((5, 623), np.float32))
    shutil.copytree(copy / MOTION / "GRAB", copy / "motionx_smplx/smplx_322/GRAB")
    shutil.copytree(copy / TEXTS / "GRAB", copy / "GRAB_text")
    (copy / MOTION / "GRAB/s1/._hidden.npy").write_bytes(b"x")
    plan = prepare(config(copy)).plan
    assert {clip.id for _, clip in plan.items} == ALL
    assert plan.totals.found == 9
    (drop,) = plan.dropped
    assert f"'{MUG}'" in drop.reason and f"{MOTION}/{MUG}.npy" in drop.reason
    assert not plan.broken


def test_links(copy: Path, tmp_path: Path) -> None:
    """Whole subsets may lie on another disk; a link to a single file outside is refused, a loop is left."""
    (copy / MOTION / "GRAB").rename(tmp_path / "elsewhere")
    (copy / MOTION / "GRAB").symlink_to(tmp_path / "elsewhere")
    (copy / "texts/loop").symlink_to(copy)
    outside = tmp_path / "outside.npy"
    shutil.copy(copy / MOTION / f"{BOW}.npy", outside)
    (copy / MOTION / "perform/evil.npy").symlink_to(outside)
    plan = prepare(config(copy)).plan
    assert {clip.id for _, clip in plan.items} == ALL
    assert [d.source for d in plan.broken] == [f"{MOTION}/perform/evil.npy"]
    assert "link" in plan.broken[0].reason


# Splits, subsets, licences


def test_subsets_frames_limit_and_licences(fixture: Path) -> None:
    plan = prepare(config(fixture, subsets=("GRAB", "aist"))).plan
    assert {clip.id for _, clip in plan.items} == {MUG, DANCE}
    assert not plan.missing
    assert len(prepare(config(fixture, limit=3)).plan.items) == 3
    plan = prepare(config(fixture, where="licence=GRAB-noncommercial")).plan
    assert {clip.id for _, clip in plan.items} == {MUG}
    assert {clip.licence for _, clip in prepare(config(fixture, licence="mine")).plan.items} == {"mine"}
    assert prepare(config(fixture, licence="mine")).facts().licence == "mine"
    assert clips_of(fixture)[DANCE].licence.endswith("AIST++-annotations-CC-BY-4.0")
    plan = prepare(config(fixture)).plan
    assert {clip.id for _, clip in plan.items} == ALL
    assert plan.totals.frames == {"train": 50 + 42 + 45 + 50 + 50, "val": 44, "test": 30 + 41}
    assert plan.totals.found == 8
