"""HumanML3D conversion: published vectors bit for bit, features from joints, dirt, splits, equal bytes."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from motionloom.datasets.check.dataset import check
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.common.splits import hash_split, keep_mirrors_together, original_of
from motionloom.datasets.convert.humanml3d.convert import (
    HumanMl3dConfig,
    plan_humanml3d,
    prepare_humanml3d,
)
from motionloom.datasets.motion.canonical import facing, heading, mirror
from motionloom.datasets.motion.features import decode
from motionloom.datasets.motion.h3d import encode_h3d
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import Caption, Manifest, Split, UserError
from motionloom.datasets.shards.index import SPLITS
from motionloom.datasets.shards.reader import ShardDataset

H3D = MotionLayout.named("h3d263")
IDS = {"train": ["900001", "900003", "M900001"], "val": ["900004"], "test": ["900002", "M900002"]}


@pytest.fixture
def fixture(shared: Path) -> Path:
    return shared / "data/layouts/humanml3d"


def convert(source: Path, out: Path, *, workers: int = 1, strict: bool = False, **options: Any) -> Manifest:
    conversion = prepare_humanml3d(HumanMl3dConfig(source=source, **options), workers=workers)
    return run_conversion(conversion, out, workers=workers, strict=strict, progress=False, clips_per_shard=2)


def plan(source: Path, **options: Any) -> Any:
    return plan_humanml3d(HumanMl3dConfig(source=source, **options))


def ids(source: Path, **options: Any) -> list[str]:
    return sorted(clip.id for _, clip in plan(source, **options).items)


def motions(out: Path) -> dict[str, NDArray[np.float32]]:
    found = {}
    for split in SPLITS:
        dataset = ShardDataset.open(out, split)
        found |= {clip_id: np.array(dataset.motion(i)) for i, clip_id in enumerate(dataset.ids)}
    return found


def reasons(drops: Any) -> dict[str, str]:
    return {drop.source: drop.reason for drop in drops}


def bytes_of(folder: Path) -> dict[str, str]:
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.iterdir())}


def published(source: Path, clip_id: str, folder: str = "new_joint_vecs") -> NDArray[np.float32]:
    values: NDArray[np.float32] = np.load(source / folder / f"{clip_id}.npy", allow_pickle=False)
    return values


@pytest.mark.parametrize("use", ["auto", "vecs"])
def test_published_vectors_are_kept_bit_for_bit(fixture: Path, tmp_path: Path, use: str) -> None:
    manifest = convert(fixture, tmp_path / "out", use=use)
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


def test_plan_accounts_for_every_file(fixture: Path) -> None:
    made = plan(fixture)
    assert made.counts() == {"train": 3, "val": 1, "test": 2}
    assert made.frames == {"train": 153, "val": 43, "test": 138}
    assert made.found == 6
    files = sum(path.is_file() for path in fixture.rglob("*"))
    assert files == made.ignored + 2 * 6 + 6 + 3  # vectors and joints, texts, split files
    assert plan(fixture, use="vecs").ignored == made.ignored + 6
    table = {name: (s.found, s.used, s.missing, s.expected) for name, s in made.subsets.items()}
    assert table == {"train": (3, 3, 0, 23384), "val": (1, 1, 0, 1460), "test": (2, 2, 0, 4384)}


def test_the_published_code_agrees_with_ours(fixture: Path) -> None:
    joints = np.load(fixture / "golden/900002_joints_in.npy", allow_pickle=False)
    offsets = np.load(fixture / "golden/tgt_offsets.npy", allow_pickle=False)
    np.testing.assert_allclose(encode_h3d(joints, H3D, offsets), published(fixture, "900002"), atol=1e-4)


@pytest.mark.parametrize("use", ["auto", "vecs", "joints"])
def test_exact_features_are_the_published_joints(fixture: Path, tmp_path: Path, use: str) -> None:
    manifest = convert(fixture, tmp_path / "out", use=use, layout="body133")
    assert check(tmp_path / "out") == []
    assert manifest.family == "exact"
    for clip_id, motion in motions(tmp_path / "out").items():
        joints = published(fixture, clip_id, "new_joints")
        assert len(motion) == len(joints)
        np.testing.assert_allclose(decode(motion, MotionLayout.named("body133")), joints, atol=1e-5)


def test_vectors_made_again_from_joints_are_close_but_not_the_same(fixture: Path, tmp_path: Path) -> None:
    """One more frame is lost, and the smoothed heading starts elsewhere: up to 7e-3 on a clip that turns."""
    convert(fixture, tmp_path / "out", use="joints")
    for clip_id, motion in motions(tmp_path / "out").items():
        vectors = published(fixture, clip_id)
        assert len(motion) == len(vectors) - 1
        np.testing.assert_allclose(motion, vectors[:-1], atol=0.01)
        assert not np.array_equal(motion, vectors[:-1])
        joints = published(fixture, clip_id, "new_joints")[:-1]
        np.testing.assert_allclose(decode(motion, H3D), joints, atol=1e-5)


@pytest.mark.parametrize("layout", ["h3d263", "body133"])
def test_walk_turn_and_mirror_after_conversion(fixture: Path, tmp_path: Path, layout: str) -> None:
    convert(fixture, tmp_path / "out", layout=layout)
    skeleton = Skeleton.named("smpl22")
    joints = {k: decode(v, MotionLayout.named(layout)) for k, v in motions(tmp_path / "out").items()}
    for clip in joints.values():
        assert abs(clip[..., 1].min()) < 1e-5  # the floor, metres
        assert 1.4 < np.ptp(clip[0, :, 1]) < 2.0  # a standing person, Y up
        assert np.abs(clip[0, 0, [0, 2]]).max() < 1e-6
        assert abs(facing(clip)[0]) < 1e-5
        left, right = (skeleton.index(f"{side}_shoulder") for side in ("left", "right"))
        assert clip[0, left, 0] > clip[0, right, 0]
    walk, mirrored = joints["900002"], joints["M900002"]
    assert walk[20, 0, 2] > 0.3  # forward
    assert 1.2 < heading(walk, 20.0)[-1] < 2.0  # "turns to the left"
    assert walk[-1, 0, 0] > 1.0
    assert -2.0 < heading(mirrored, 20.0)[-1] < -1.2
    # The source mirrors before it makes the skeleton uniform, so a pair agrees to centimetres.
    for clip_id in ("900001", "900002"):
        np.testing.assert_allclose(mirror(joints[clip_id], skeleton), joints[f"M{clip_id}"], atol=0.05)


def test_other_rate_and_uniform_bones(fixture: Path, tmp_path: Path) -> None:
    convert(fixture, tmp_path / "fast", fps=30.0, layout="body133")
    assert len(motions(tmp_path / "fast")["900001"]) == 76  # 50 steps of 50 ms -> 75 of 33 ms
    convert(fixture, tmp_path / "bones", retarget=True)
    skeleton = Skeleton.named("smpl22")
    joints = decode(motions(tmp_path / "bones")["900001"], H3D)
    lengths = np.linalg.norm(joints[:, 1:] - joints[:, list(skeleton.parents[1:])], axis=-1)
    wanted = np.linalg.norm(skeleton.offsets[1:], axis=-1)
    np.testing.assert_allclose(lengths, np.broadcast_to(wanted, lengths.shape), atol=1e-4)


def test_workers_and_a_second_run_give_the_same_bytes(fixture: Path, tmp_path: Path) -> None:
    convert(fixture, tmp_path / "one")
    convert(fixture, tmp_path / "two", workers=2)
    assert bytes_of(tmp_path / "one") == bytes_of(tmp_path / "two")
    convert(fixture, tmp_path / "one")
    assert bytes_of(tmp_path / "one") == bytes_of(tmp_path / "two")


def test_changed_captions_are_noticed(copy: Path, tmp_path: Path) -> None:
    convert(copy, tmp_path / "out")
    (copy / "texts/900004.txt").write_text("a person waves.#a/DET#0.0#0.0\n")
    convert(copy, tmp_path / "out")
    assert ShardDataset.open(tmp_path / "out", "val").texts(0)[0].text == "a person waves."


# --- dirt ---------------------------------------------------------------------------------------------------


def test_a_clip_with_nan_is_left_out(copy: Path, tmp_path: Path) -> None:
    vectors = published(copy, "900003")
    vectors[7, 3] = np.nan
    np.save(copy / "new_joint_vecs/900003.npy", vectors)
    manifest = convert(copy, tmp_path / "out")
    (reason,) = reasons(manifest.dropped).values()
    assert "frame 7" in reason and "column 3" in reason
    assert "900003" not in motions(tmp_path / "out")
    assert check(tmp_path / "out") == []
    with pytest.raises(UserError, match="900003"):
        convert(copy, tmp_path / "strict", strict=True)


def test_files_that_disagree_are_left_out_with_the_way_out(copy: Path, tmp_path: Path) -> None:
    joints = published(copy, "900001", "new_joints")
    joints[:, 20] += 0.3
    np.save(copy / "new_joints/900001.npy", joints)
    manifest = convert(copy, tmp_path / "out")
    assert list(reasons(manifest.dropped)) == ["new_joint_vecs/900001.npy"]
    assert "differs from new_joints/900001.npy by 0.52 m" in manifest.dropped[0].reason
    assert convert(copy, tmp_path / "vecs", use="vecs").dropped == []


def test_lengths_that_disagree_and_broken_files(copy: Path, shared: Path) -> None:
    np.save(copy / "new_joints/900001.npy", published(copy, "900001", "new_joints")[:-1])
    raw = (copy / "new_joint_vecs/900003.npy").read_bytes()
    (copy / "new_joint_vecs/900003.npy").write_bytes(raw[:-100])
    shutil.copyfile(shared / "data/broken/npy/object_dtype.npy", copy / "new_joints/900004.npy")
    broken = reasons(plan(copy).broken)
    assert "frames differ" in broken["new_joint_vecs/900001.npy"]
    assert "truncated" in broken["new_joint_vecs/900003.npy"]
    assert "object array" in broken["new_joints/900004.npy"]
    assert not list(Path.cwd().glob("PWNED_*"))
    assert ids(copy, use="vecs") == ["900001", "900002", "900004", "M900001", "M900002"]


def test_a_figure_in_the_wrong_unit_is_left_out(copy: Path, tmp_path: Path) -> None:
    np.save(copy / "new_joints/900001.npy", published(copy, "900001", "new_joints") * 100)
    manifest = convert(copy, tmp_path / "out", use="joints")
    assert "is the length unit right?" in reasons(manifest.dropped)["new_joints/900001.npy"]


def test_one_folder_stands_in_for_the_other(copy: Path, tmp_path: Path) -> None:
    (copy / "new_joint_vecs/900004.npy").unlink()
    convert(copy, tmp_path / "out")
    assert check(tmp_path / "out") == []
    assert ShardDataset.open(tmp_path / "out", "val").meta(0).source == "new_joints/900004.npy"
    made = plan(copy, use="vecs")
    assert made.notes == ["1 caption files in texts/ belong to no motion file here"]
    assert reasons(made.missing) == {"900004": "listed in val.txt, but not in new_joint_vecs/"}
    shutil.rmtree(copy / "new_joint_vecs")
    with pytest.raises(UserError, match="no new_joint_vecs/ in it"):
        plan(copy, use="vecs")


def test_texts_that_are_missing_or_broken(copy: Path, shared: Path, tmp_path: Path) -> None:
    broken = shared / "data/broken/texts"
    shutil.copyfile(broken / "bad_timestamps.txt", copy / "texts/900001.txt")
    shutil.copyfile(broken / "empty_caption.txt", copy / "texts/900003.txt")
    shutil.copyfile(broken / "non_utf8.txt", copy / "texts/900004.txt")
    (copy / "texts/900002.txt").unlink()
    made = plan(copy)
    assert ids(copy) == ["M900001", "M900002"]
    vecs = [f"new_joint_vecs/{clip_id}.npy" for clip_id in ("900001", "900002", "900003", "900004")]
    assert made.uncaptioned == vecs
    assert reasons(made.dropped) == dict.fromkeys(vecs, "no usable caption")
    assert "byte 25" in reasons(made.broken)["texts/900004.txt"]
    told = [note for note in made.notes if note.startswith("texts/900001.txt")]
    assert all(f"line {number}: " in told[0] for number in (1, 2, 3, 4))
    assert any(note == "texts/900003.txt: line 1: the caption is empty" for note in made.notes)
    kept = convert(copy, tmp_path / "out", uncaptioned="keep")
    assert sum(shard.samples for shard in kept.shards) == 6
    assert check(tmp_path / "out") == []


def test_texts_one_folder_too_deep_or_still_packed(copy: Path) -> None:
    (copy / "texts").rename(copy / "unpacked")
    (copy / "texts.zip").touch()
    with pytest.raises(UserError, match=r"no texts/ in it; unpack texts\.zip"):
        plan(copy)
    assert len(plan(copy, uncaptioned="keep").items) == 6
    (copy / "texts").mkdir()
    (copy / "unpacked").rename(copy / "texts/texts")
    assert len(plan(copy).items) == 6


def test_a_mirrored_text_that_names_the_old_side_is_noted(copy: Path) -> None:
    assert plan(copy).notes == []  # M900001 repeats its original's text, which names no side
    shutil.copyfile(copy / "texts/900002.txt", copy / "texts/M900002.txt")
    (note,) = plan(copy).notes
    assert note.startswith("1 mirrored clips repeat a caption of their original that names a side")
    assert "M900002 'a person walks forward and then turns to the left.'" in note


def test_length_licence_limit_and_layout(copy: Path) -> None:
    made = plan(copy, min_seconds=2.5, max_seconds=3.0)
    assert [clip.id for _, clip in made.items] == ["900001", "900003", "M900001"]
    assert "longer than 3 s" in reasons(made.dropped)["new_joint_vecs/900002.npy"]
    assert "shorter than 2.5 s" in reasons(made.dropped)["new_joint_vecs/900004.npy"]
    assert ids(copy, allow_licence=("MIT",)) == []
    assert len(ids(copy, licence="MIT", allow_licence=("MIT",))) == 6
    limited = plan(copy, limit=2)
    assert len(limited.items) == 2
    assert "limited to 2 of 6 clips" in limited.notes
    with pytest.raises(UserError, match="wholebody313 cannot be made from HumanML3D; use h3d263 or body133"):
        plan(copy, layout="wholebody313")


# --- splits -------------------------------------------------------------------------------------------------


def use_split(copy: Path, shared: Path, **files: str) -> None:
    """Replace the split files by those of the broken folder."""
    for split in SPLITS:
        (copy / f"{split}.txt").unlink()
    for split, name in files.items():
        shutil.copyfile(shared / f"data/broken/splits/{name}.txt", copy / f"{split}.txt")


def test_an_id_twice_is_reported_and_kept_once(copy: Path, shared: Path) -> None:
    use_split(copy, shared, train="duplicate_ids")
    made = plan(copy)
    assert [clip.id for _, clip in made.items] == ["900001", "900002"]
    assert made.notes == ["train.txt:3: '900001' is listed twice; the first line counts"]
    assert reasons(made.dropped)["new_joint_vecs/900003.npy"] == "in no split file"
    assert made.subsets["in no split"].found == 4


def test_a_listed_id_without_motion_is_counted(copy: Path, shared: Path, tmp_path: Path) -> None:
    use_split(copy, shared, train="missing_file_id")
    made = plan(copy)
    reason = "listed in train.txt, but not in new_joint_vecs/ or new_joints/"
    assert reasons(made.missing) == {"123456": reason}
    assert made.subsets["train"].missing == 1
    assert reasons(convert(copy, tmp_path / "out").dropped)["123456"] == reason
    with pytest.raises(UserError, match="123456: listed in train"):
        convert(copy, tmp_path / "strict", strict=True)


def test_an_id_in_two_splits_is_an_error(copy: Path, shared: Path) -> None:
    use_split(copy, shared, train="overlap_train", test="overlap_test")
    with pytest.raises(UserError, match=r"test\.txt:1: '900002' is also in train\.txt"):
        plan(copy)


def test_an_id_that_leaves_the_folder_is_refused(copy: Path, shared: Path) -> None:
    use_split(copy, shared, train="traversal_id")
    with pytest.raises(UserError, match=r"train\.txt:1: .*not a plain relative name"):
        plan(copy)


def test_crlf_and_blank_lines_are_fine(copy: Path, shared: Path) -> None:
    use_split(copy, shared, train="crlf_blank")
    made = plan(copy)
    assert [clip.id for _, clip in made.items] == ["900001", "900002"]
    assert made.notes == []


def test_a_mirror_image_in_another_split_is_an_error(copy: Path) -> None:
    (copy / "train.txt").write_text("900001\n900003\nM900002\n")
    (copy / "test.txt").write_text("900002\n")
    told = r"/train\.txt:3: 'M900002' mirrors '900002', which is in .*/test\.txt:1; .* two splits leak"
    with pytest.raises(UserError, match=told):
        plan(copy)
    with pytest.raises(UserError, match=r"^train\.txt: 'M1' mirrors '1', which is in val\.txt;"):
        keep_mirrors_together({"M1": "train", "1": "val", "M2": "test"}, original_of)


def test_without_split_files_pairs_stay_together(copy: Path, shared: Path) -> None:
    use_split(copy, shared)
    made = plan(copy)
    splits: dict[str, Split] = {clip.id: split for split, clip in made.items}
    assert splits == {clip_id: hash_split(clip_id.removeprefix("M")) for clip_id in splits}
    assert made.notes == ["no train.txt, val.txt or test.txt: split 80/5/15 by hash of the id"]
    keep_mirrors_together(splits, original_of)


def test_names_of_mirrored_clips() -> None:
    assert original_of("M007482") == "007482"
    assert original_of("humanml/M007482") == "humanml/007482"
    assert [original_of(name) for name in ("007482", "M1/007482", "Mug_toast_1", "humanml/M1a")] == [None] * 4


def test_links_out_of_the_source_are_not_followed(copy: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside.npy"
    shutil.move(copy / "new_joint_vecs/900001.npy", outside)
    (copy / "new_joint_vecs/900001.npy").symlink_to(outside)
    assert "a link that leaves new_joint_vecs/" in reasons(plan(copy).broken)["new_joint_vecs/900001.npy"]
    # A whole folder on another disk is the user's own choice.
    (copy / "new_joints").rename(tmp_path / "elsewhere")
    (copy / "new_joints").symlink_to(tmp_path / "elsewhere")
    assert len(ids(copy, use="joints")) == 6
