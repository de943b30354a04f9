"""Splits by hash and by files: shares, leaks, ids that are no plain names."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from motionloom.datasets.convert.common.splits import hash_split, read_split_files
from motionloom.datasets.schema import UserError


def test_hash_split_is_80_5_15() -> None:
    counts = Counter(hash_split(f"clip {i}") for i in range(20_000))
    assert counts["train"] / 20_000 == pytest.approx(0.80, abs=0.01)
    assert counts["val"] / 20_000 == pytest.approx(0.05, abs=0.005)


def test_leaks_and_ids_that_leave_the_folder_are_refused(tmp_path: Path) -> None:
    (tmp_path / "train.txt").write_text("900001\n900002\n")
    (tmp_path / "test.txt").write_text("900002\n900003\n")
    with pytest.raises(UserError, match=r"900002.*leaks"):
        read_split_files(tmp_path)
    (tmp_path / "train.txt").unlink()
    (tmp_path / "test.txt").write_text("../../../../etc/passwd\n")
    with pytest.raises(UserError, match="not a plain relative name"):
        read_split_files(tmp_path)
    (tmp_path / "test.txt").write_text("900001\n900002\n900001\n")
    splits, notes = read_split_files(tmp_path)
    assert splits["900001"] == "test" and len(notes) == 1
    (tmp_path / "test.txt").write_bytes(b"900001\r\n\r\n900002\r\n")
    assert len(read_split_files(tmp_path)[0]) == 2
    (tmp_path / "test.txt").unlink()
    with pytest.raises(UserError, match=r"no train\.txt"):
        read_split_files(tmp_path)
