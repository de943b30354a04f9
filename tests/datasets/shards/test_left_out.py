"""What was left out: one line a reason, each thing counted once, and a file with all of it."""

from __future__ import annotations

from pathlib import Path

from motionloom.datasets.schema import Dropped
from motionloom.datasets.shards.left_out import LEFT_OUT_FILE, grouped, kind_of_reason, tally, write_left_out


def drops(*reasons: str) -> list[Dropped]:
    return [Dropped(source=f"take/{k}.bvh", reason=reason) for k, reason in enumerate(reasons)]


def test_twenty_identical_messages_are_one_line() -> None:
    (group,) = grouped(drops(*["no captions"] * 20))
    assert str(group) == "20 x no captions (the first: take/0.bvh)" and group.count == 20


def test_reasons_stay_apart_the_largest_first_and_single_ones_whole() -> None:
    groups = grouped(drops("in no split file", "NaN at frame 3", "in no split file"))
    assert list(map(str, groups)) == [
        "2 x in no split file (the first: take/0.bvh)",
        "take/1.bvh: NaN at frame 3",
    ]
    assert kind_of_reason("take/1.bvh: line 7 of x.txt moves at 41.5 m/s", "take/1.bvh") == (
        "…: line … of … moves at … …"
    )


def test_each_thing_is_counted_once_and_by_its_kind() -> None:
    listed = [
        Dropped(source="a.npy", reason="no usable caption"),
        Dropped(source="a.npy", reason="shorter than 1 s"),
        Dropped(source="a.txt", reason="not UTF-8", kind="unreadable"),
        Dropped(source="b.txt", reason="not UTF-8", kind="unreadable"),
        Dropped(source="gone", reason="listed, but not here", kind="missing"),
    ]
    assert tally(listed) == "1 rejected, 2 unreadable files, 1 missing"
    assert tally(listed[2:3]) == "1 unreadable file" and tally([]) == ""


def test_the_list_is_one_line_each_and_goes_when_there_is_nothing(tmp_path: Path) -> None:
    names = [
        Dropped(source="a\nb.bvh", reason="odd\tname \x1b[31m", kind="unreadable"),
        *drops("no captions"),
    ]
    write_left_out(tmp_path, names)
    assert (tmp_path / LEFT_OUT_FILE).read_text() == (
        "unreadable\ta\\nb.bvh\todd\\tname \\x1b[31m\nrejected\ttake/0.bvh\tno captions\n"
    )
    write_left_out(tmp_path, [])
    write_left_out(tmp_path, [])
    assert list(tmp_path.iterdir()) == []
