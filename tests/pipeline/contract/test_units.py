"""Work in units: every unit once, by whichever process, in order, and not again after a kill."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.contract.units import Arrays, Units, as_rows, as_table, even_slices


def test_processes_make_each_unit_once_and_read_all_in_order(tmp_path: Path) -> None:
    made: list[tuple[int, int]] = []
    for rank in range(3):

        def result(index: int, rank: int = rank) -> Arrays:
            made.append((rank, index))
            return {"value": np.array([index, index * index])}

        units = Units(tmp_path / "work", rank, 3)
        units.make("squares", 8, result)
        assert units.mine([1] * 8) == [3, 3, 2][rank]
    assert sorted(index for _, index in made) == list(range(8))
    assert all(index % 3 == rank for rank, index in made)
    found = [unit["value"].tolist() for unit in Units(tmp_path / "work").read("squares", 8)]
    assert found == [[k, k * k] for k in range(8)]


def test_what_a_killed_process_has_made_is_not_made_again(tmp_path: Path) -> None:
    made: list[int] = []

    def result(index: int) -> Arrays:
        if index == 3 and len(made) == 3:
            raise KeyboardInterrupt
        made.append(index)
        return {"value": np.array(index)}

    units = Units(tmp_path / "work")
    with pytest.raises(KeyboardInterrupt):
        units.make("a", 6, result)
    made.append(-1)
    done: list[int] = []
    units.make("a", 6, result, done.append)
    assert made == [0, 1, 2, -1, 3, 4, 5] and done == list(range(6))
    units.clear()
    assert not (tmp_path / "work").exists()


def test_a_unit_of_objects_is_refused(tmp_path: Path) -> None:
    """Pickles are never written, and a file that was to be one is not left behind."""
    units = Units(tmp_path / "work")
    with pytest.raises(ValueError, match="allow_pickle"):
        units.make("a", 1, lambda _: {"value": np.array([{}], dtype=object)})
    assert not any((tmp_path / "work").glob("a-*.npz"))


@pytest.mark.parametrize("damage", ["empty", "cut", "other bytes", "one array alone"])
def test_a_damaged_unit_is_named_and_made_anew_once_deleted(damage: str, tmp_path: Path) -> None:
    units = Units(tmp_path / "work")
    units.make("a", 3, lambda index: {"value": np.arange(1000.0) + index})
    path = tmp_path / "work" / "a-000001.npz"
    whole = path.read_bytes()
    if damage == "one array alone":
        with path.open("wb") as file:
            np.save(file, np.ones(3))
    else:
        middle = whole[:2000] + bytes(8) + whole[2008:]
        path.write_bytes({"empty": b"", "cut": whole[:500], "other bytes": middle}[damage])
    with pytest.raises(UserError, match=r"a-000001\.npz: damaged \(.*delete it"):
        list(units.read("a", 3))
    path.unlink()
    units.make("a", 3, lambda index: {"value": np.arange(1000.0) + index})
    assert [unit["value"][0] for unit in units.read("a", 3)] == [0, 1, 2] and path.read_bytes() == whole


@pytest.mark.parametrize(("count", "most"), [(0, 4), (1, 4), (4, 4), (97, 64), (400, 64)])
def test_slices_cover_all_and_are_nearly_equal(count: int, most: int) -> None:
    found = even_slices(count, most)
    assert [k for piece in found for k in range(piece.start, piece.stop)] == list(range(count))
    sizes = [piece.stop - piece.start for piece in found] or [0]
    assert max(sizes) <= most and max(sizes) - min(sizes) <= 1


def test_rows_and_tables() -> None:
    rows = [{"a": 1.0, "b": 2.0}, {"b": 3.0}, {"c": 0.0}]
    table = as_table(rows, "x/") | as_table([{"d": 1.0}] * 3)
    assert as_rows(table, "x/") == rows
    assert as_rows({}) == [] and as_table([]) == {}
