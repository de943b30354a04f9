"""Every file of the broken set gets the verdict that its EXPECT.md demands, through what users can call."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from motionloom.datasets.check.files import FileRules, Verdict, check_file, check_folder
from motionloom.datasets.convert.common.splits import read_split_files
from motionloom.datasets.schema import UserError

REJECTED: dict[str, list[str] | None] = yaml.safe_load(
    Path(__file__).with_name("broken.yaml").read_text("utf-8")
)
"""File -> words that the refusal must hold; None for a file that is to be read."""
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
    assert verdict.ok == (words is None), verdict
    assert str(verdict).startswith(f"{broken / name}: ")
    for word in words or ("ok",):
        assert word in str(verdict)


def test_a_folder_is_checked_file_by_file_and_the_table_has_every_one(broken: Path) -> None:
    verdicts = list(check_folder(broken, RULES))
    assert len(verdicts) == 62
    assert {str(v.path.relative_to(broken)) for v in verdicts if v.ok} == {
        name for name, words in REJECTED.items() if words is None
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
