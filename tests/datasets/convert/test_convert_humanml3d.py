"""HumanML3D conversion: published vectors bit for bit, features from joints, dirt, splits, equal bytes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from amass_clips import features as motions
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import SPLITS, Caption, Manifest, Split
from motionloom.datasets.check.dataset import check
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.common.splits import hash_split
from motionloom.datasets.convert.humanml3d.convert import HumanMl3dConfig
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.motion.features.codec import decode
from motionloom.datasets.motion.features.h3d import encode_h3d
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.reader import ShardDataset

H3D = MotionLayout.named("h3d263")
IDS = {"train": ["900001", "900003", "M900001"], "val": ["900004"], "test": ["900002", "M900002"]}


@pytest.fixture
def fixture(shared: Path) -> Path:
    return shared / "data/layouts/humanml3d"


def convert(source: Path, out: Path, *, workers: int = 1, **options: Any) -> Manifest:
    conversion = prepare(HumanMl3dConfig(source=source, **options), workers=workers)
    return run_conversion(conversion, out, workers=workers, progress=False, clips_per_shard=2)


def plan(source: Path, **options: Any) -> Any:
    return prepare(HumanMl3dConfig(source=source, **options)).plan


def ids(source: Path, **options: Any) -> list[str]:
    return sorted(clip.id for _, clip in plan(source, **options).items)


def reasons(drops: Any) -> dict[str, str]:
    return {drop.source: drop.reason for drop in drops}


def published(source: Path, clip_id: str, folder: str = "new_joint_vecs") -> NDArray[np.float32]:
    values: NDArray[np.float32] = np.load(source / folder / f"{clip_id}.npy", allow_pickle=False)
    return values


def test_published_vectors_are_kept_bit_for_bit(fixture: Path, tmp_path: Path) -> None:
    manifest = convert(fixture, tmp_path / "out")
    assert check(tmp_path / "out") == []
    assert (manifest.layout, manifest.family, manifest.fps) == ("h3d263", "h3d", 20.0)
    assert (manifest.dropped, manifest.notes) == ([], [])
    found = motions(tmp_path / "out")
    assert sorted(found) == sorted(clip_id for split in IDS.values() for clip_id in split)
    for clip_id, motion in found.items():
        np.testing.assert_array_equal(motion, published(fixture, clip_id))


def test_samples_say_what_they_are(fixture: Path, tmp_path: Path) -> None:
    manifest = convert(fixture, tmp_path / "out")
    assert str(fixture) not in json.dumps(manifest.dump())
    assert "non-commercial" in manifest.licence
    assert manifest.licences == {manifest.licence: 6}
    for split in SPLITS:
        dataset = ShardDataset.open(tmp_path / "out", split)
        assert sorted(dataset.ids) == IDS[split]
        for i, clip_id in enumerate(dataset.ids):
            meta = dataset.meta(i)
            assert meta.source == f"new_joint_vecs/{clip_id}.npy"
            assert meta.mirror_of == (clip_id[1:] if clip_id.startswith("M") else None)
            assert (meta.has_hands, meta.has_face, meta.licence) == (False, False, manifest.licence)
    val = ShardDataset.open(tmp_path / "out", "val")
    tokens = ["a/DET", "person/NOUN", "wave/VERB", "with/ADP", "their/DET", "right/ADJ", "hand/NOUN"]
    text = "a person waves with their right hand."
    assert val.texts(0) == [Caption(text=text, tokens=tokens, source="humanml3d")]
    test = ShardDataset.open(tmp_path / "out", "test")
    spans = [(c.start, c.end) for c in test.texts(test.ids.index("900002"))]
    assert spans == [(0.0, None), (0.0, None), (0.0, 2.0), (1.0, 3.45)]
    made = plan(fixture)
    assert made.counts() == {"train": 3, "val": 1, "test": 2}
    assert made.totals.frames == {"train": 153, "val": 43, "test": 138}
    assert made.totals.found == 6


def test_the_published_code_agrees_with_ours(fixture: Path) -> None:
    joints = np.load(fixture / "golden/900002_joints_in.npy", allow_pickle=False)
    offsets = np.load(fixture / "golden/tgt_offsets.npy", allow_pickle=False)
    np.testing.assert_allclose(encode_h3d(joints, H3D, offsets), published(fixture, "900002"), atol=1e-4)


@pytest.mark.parametrize("gone", [None, "new_joint_vecs", "new_joints"])
def test_exact_features_are_the_published_joints(
    fixture: Path, copy: Path, tmp_path: Path, gone: str | None
) -> None:
    if gone:
        shutil.rmtree(copy / gone)
    manifest = convert(copy, tmp_path / "out", layout="body133")
    assert check(tmp_path / "out") == []
    assert manifest.family == "exact"
    for clip_id, motion in motions(tmp_path / "out").items():
        joints = published(fixture, clip_id, "new_joints")
        assert len(motion) == len(joints)
        np.testing.assert_allclose(decode(motion, MotionLayout.named("body133")), joints, atol=1e-5)


def test_vectors_made_again_from_joints_are_close_but_not_the_same(
    fixture: Path, copy: Path, tmp_path: Path
) -> None:
    """One more frame is lost, and the smoothed heading starts elsewhere: up to 7e-3 on a clip that turns."""
    shutil.rmtree(copy / "new_joint_vecs")
    convert(copy, tmp_path / "out")
    for clip_id, motion in motions(tmp_path / "out").items():
        vectors = published(fixture, clip_id)
        assert len(motion) == len(vectors) - 1
        np.testing.assert_allclose(motion, vectors[:-1], atol=0.01)
        assert not np.array_equal(motion, vectors[:-1])
        joints = published(fixture, clip_id, "new_joints")[:-1]
        np.testing.assert_allclose(decode(motion, H3D), joints, atol=1e-5)


# --- dirt ---------------------------------------------------------------------------------------------------


def test_one_folder_stands_in_for_the_other(copy: Path, tmp_path: Path) -> None:
    (copy / "new_joint_vecs/900004.npy").unlink()
    convert(copy, tmp_path / "out")
    assert check(tmp_path / "out") == []
    assert ShardDataset.open(tmp_path / "out", "val").meta(0).source == "new_joints/900004.npy"
    (copy / "new_joints/900004.npy").unlink()
    made = plan(copy)
    assert [note.startswith("1 caption files") for note in made.notes] == [True]
    assert "val.txt" in reasons(made.missing)["900004"] and len(made.missing) == 1
    for folder in ("new_joint_vecs", "new_joints"):
        shutil.rmtree(copy / folder)
    with pytest.raises(UserError, match="no new_joint_vecs/ or new_joints/ in it"):
        plan(copy)


def test_a_file_changed_in_place_is_converted_again(copy: Path, tmp_path: Path) -> None:
    convert(copy, tmp_path / "out")
    path = copy / "new_joint_vecs/900001.npy"
    np.save(path, np.load(path) * np.float32(1.00001))
    convert(copy, tmp_path / "out")
    convert(copy, tmp_path / "fresh")
    found, fresh = (motions(tmp_path / name) for name in ("out", "fresh"))
    np.testing.assert_array_equal(found["900001"], np.load(path))
    assert all(np.array_equal(found[clip_id], motion) for clip_id, motion in fresh.items())


def test_texts_one_folder_too_deep_or_still_packed(copy: Path) -> None:
    (copy / "texts").rename(copy / "unpacked")
    (copy / "texts.zip").touch()
    with pytest.raises(UserError, match=r"unpack texts\.zip"):
        plan(copy)
    assert len(plan(copy, uncaptioned="keep").items) == 6
    (copy / "texts").mkdir()
    (copy / "unpacked").rename(copy / "texts/texts")
    assert len(plan(copy).items) == 6


# --- splits -------------------------------------------------------------------------------------------------


def test_a_mirror_image_in_another_split_is_an_error_and_without_splits_pairs_stay_together(
    copy: Path,
) -> None:
    (copy / "train.txt").write_text("900001\n900003\nM900002\n")
    (copy / "test.txt").write_text("900002\n")
    told = r"'M900002' of train\.txt mirrors '900002', .* test\.txt; .* two splits leak"
    with pytest.raises(UserError, match=told):
        plan(copy)
    for split in SPLITS:
        (copy / f"{split}.txt").unlink()
    made = plan(copy)
    splits: dict[str, Split] = {clip.id: split for split, clip in made.items}
    assert splits == {clip_id: hash_split(clip_id.removeprefix("M")) for clip_id in splits}
    assert ["80/5/15" in note for note in made.notes] == [True]


def test_two_copies_of_a_motion_are_compared(copy: Path, tmp_path: Path) -> None:
    """Vectors of two ids exchanged, and a copy of other length: both paths are said, the others converted."""
    vectors = copy / "new_joint_vecs"
    first, second = (vectors / f"{name}.npy" for name in ("900001", "900003"))
    first.rename(vectors / "x"), second.rename(first), (vectors / "x").rename(second)
    np.save(copy / "new_joints/900004.npy", np.load(copy / "new_joints/900004.npy")[:-3])
    assert "40" in reasons(plan(copy).broken)["new_joint_vecs/900004.npy"]
    manifest = convert(copy, tmp_path / "out", most_rejected=1)
    for name in ("900001", "900003"):
        assert f"new_joints/{name}.npy" in reasons(manifest.dropped)[f"new_joint_vecs/{name}.npy"]
    assert sum(shard.samples for shard in manifest.shards) == 3
