"""Every file of the broken set gets the verdict that its EXPECT.md demands, through what users can call."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from motionloom.datasets.check.files import FileRules, Verdict, check_file, check_folder
from motionloom.datasets.convert.common.splits import read_split_files
from motionloom.datasets.schema import UserError

OK = None
REJECTED: dict[str, tuple[str, ...] | None] = {
    # file -> words that the refusal must hold, or OK
    "npy/truncated.npy": ("truncated", "15456", "10261"),
    "npy/truncated_header.npy": ("header",),
    "npy/empty_file.npy": ("empty",),
    "npy/nan.npy": ("nan", "frame 5", "column 10"),
    "npy/inf.npy": ("inf", "frame 3", "column 309"),
    "npy/wrong_dims_321.npy": ("322", "321"),
    "npy/transposed.npy": ("[T, 322]", "[322, 12]"),
    "npy/one_dim.npy": ("[T, 322]", "[322]"),
    "npy/three_dim.npy": ("[T, 322]", "[1, 12, 322]"),
    "npy/zero_length.npy": ("zero length",),
    "npy/huge_values.npy": ("absurd", "frame"),
    "npy/object_dtype.npy": ("object",),
    "npy/complex_dtype.npy": ("complex64", "float32"),
    "npy/big_endian.npy": OK,
    "npy/fortran_order.npy": OK,
    "npy/control_ok.npy": OK,
    "aist/gBR_sBM_cAll_d04_mBR0_ch66_malicious.pkl": ("refused", "io.open"),
    "aist/missing_key.pkl": ("smpl_scaling",),
    "aist/length_mismatch.pkl": ("9", "8"),
    "aist/zero_scaling.pkl": ("smpl_scaling", "0"),
    "aist/truncated.pkl": ("cut short",),
    "shards/control_ok.tar": OK,
    "shards/truncated.tar": ("truncated", "'000001", "last whole key is '000000'"),
    "shards/no_end_blocks.tar": OK,
    "shards/path_traversal.tar": ("../../PWNED_tar.txt", "path traversal"),
    "shards/symlink_member.tar": ("000009.motion.npy", "link", "plain files"),
    "shards/duplicate_keys.tar": ("duplicate key '000000'",),
    "shards/duplicate_member.tar": ("000000.motion.npy", "twice", "duplicate member"),
    "shards/split_sample.tar": ("'000000'", "missing field"),
    "shards/missing_field.tar": ("key '000001' has no",),
    "shards/bad_json.tar": ("'000000.json'", "not valid JSON"),
    "shards/not_a_tar.tar": ("not a readable tar",),
    "shards/zero_bytes.tar": ("empty", "0 bytes"),
    "bvh/control_ok.bvh": OK,
    "bvh/missing_frames.bvh": ("10", "6 found"),
    "bvh/extra_frames.bvh": ("4", "6 found"),
    "bvh/wrong_channel_count.bvh": ("frame 3", "127", "132"),
    "bvh/declared_channels_mismatch.bvh": ("CHANNELS 3", "6"),
    "bvh/not_a_number.bvh": ("1.#QNAN",),
    "bvh/frame_time_zero.bvh": ("Frame Time", "0"),
    "bvh/no_motion.bvh": ("MOTION",),
    "bvh/unbalanced_braces.bvh": ("braces",),
    "bvh/non_utf8.bvh": ("not UTF-8", "line"),
    "bvh/crlf_bom.bvh": OK,
    "texts/bad_timestamps.txt": ("line 1", "line 2", "line 3", "line 4", "no usable text"),
    "texts/nan_tags.txt": OK,
    "texts/too_few_fields.txt": ("line 1", "line 2", "fields"),
    "texts/extra_hash.txt": OK,
    "texts/empty_caption.txt": ("no usable text",),
    "texts/empty_file.txt": ("no usable text",),
    "texts/non_utf8.txt": ("not UTF-8", "byte 25"),
    "wav/zero_samples.wav": ("0 samples",),
    "wav/truncated.wav": ("cut short", "1600", "16000"),
    "wav/sample_rate_zero.wav": ("sample rate",),
    "wav/not_riff.wav": ("not a WAV",),
    "wav/float_nan.wav": ("NaN",),
    "splits/duplicate_ids.txt": OK,
    "splits/missing_file_id.txt": OK,
    "splits/overlap_train.txt": OK,
    "splits/overlap_test.txt": OK,
    "splits/traversal_id.txt": ("../../../../etc/passwd",),
    "splits/crlf_blank.txt": OK,
}
RULES = FileRules(seconds=10.0)


@pytest.fixture(autouse=True)
def untouched(shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Runs in an empty folder, and fails if any payload ran or anything was written."""
    here = tmp_path / "cwd"
    here.mkdir()
    monkeypatch.chdir(here)
    broken = shared / "data" / "broken"
    before = sorted(broken.rglob("*"))
    yield here
    assert not list(here.iterdir()), "reading wrote something"
    assert not list(Path("/tmp").glob("PWNED_*")) and not list(tmp_path.rglob("PWNED_*"))
    assert sorted(broken.rglob("*")) == before


@pytest.fixture
def broken(shared: Path) -> Path:
    return shared / "data" / "broken"


@pytest.mark.parametrize("name", REJECTED)
def test_verdict(broken: Path, name: str) -> None:
    verdict = check_file(broken / name, RULES)  # no exception of any class
    words = REJECTED[name]
    assert verdict.ok == (words is OK), verdict
    assert str(verdict).startswith(f"{broken / name}: ")
    for word in words or ("ok",):
        assert word in str(verdict)


def test_a_folder_is_checked_file_by_file_and_the_table_has_every_one(broken: Path) -> None:
    verdicts = list(check_folder(broken, RULES))
    assert len(verdicts) == 62
    assert {str(v.path.relative_to(broken)) for v in verdicts if v.ok} == {
        name for name, words in REJECTED.items() if words is OK
    }
    there = {str(path.relative_to(broken)) for path in broken.rglob("*") if path.is_file()}
    assert there - {"EXPECT.md"} == set(REJECTED) and len(REJECTED) == 62


def test_an_amc_is_checked_with_its_skeleton(tmp_path: Path) -> None:
    path = tmp_path / "07_01.amc"
    path.write_text("1\nroot 0 0 0 0 0 0\n2\nroot 0 1 0 0 0 0\n")
    assert "07.asf" in str(check_file(path, RULES))
    bone = "begin\nid 1\nname leg\ndirection 0 -1 0\nlength 2\naxis 0 0 0 XYZ\nend"
    root = ":root\norder TX TY TZ RX RY RZ"
    (tmp_path / "07.asf").write_text(f"{root}\n:bonedata\n{bone}\n:hierarchy\nroot leg\n")
    assert str(check_file(path, RULES)).endswith("2 frames, 120 fps")


def test_splits_that_overlap_are_an_error(broken: Path, tmp_path: Path) -> None:
    folder = tmp_path / "split_folder"
    folder.mkdir()
    for split in ("train", "test"):
        shutil.copy(broken / f"splits/overlap_{split}.txt", folder / f"{split}.txt")
    with pytest.raises(UserError, match=r"'900002'.*train\.txt"):
        read_split_files(folder)
    verdicts: list[Verdict] = list(check_folder(folder))
    assert [verdict.ok for verdict in verdicts] == [False, True, True]
    assert "900002" in str(verdicts[0])
