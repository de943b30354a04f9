"""Every reader of outside bytes stands in the fuzzer's table, and answers damaged inputs with a sentence."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from motionloom.datasets.convert.common.converter import CONVERTERS

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def fuzz() -> Any:
    """The module of the command, whose table is full."""
    sys.path.insert(0, str(FOLDER))
    try:
        import fuzz
    finally:
        sys.path.remove(str(FOLDER))
    return fuzz


def test_what_is_not_in_the_table_is_told(fuzz: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    assert fuzz.missing() == []
    monkeypatch.setitem(CONVERTERS._things, "toy", object)  # type: ignore[arg-type]
    requests = sys.modules["fuzzing.requests"]
    monkeypatch.setattr(requests, "ROUTES", [one for one in requests.ROUTES if one != "/api/edit"])
    monkeypatch.delitem(fuzz.READERS, "checkpoint")
    lacking = "\n".join(fuzz.missing())
    assert "no seeds for the converter toy" in lacking and "no seeds for the request /api/edit" in lacking
    assert "no reader covers pipeline/training/checkpointing.py (torch.load" in lacking


@pytest.mark.parametrize("seeds", [[], [b"some"]])
def test_a_reader_without_a_seed_or_a_mutator_ends_the_run(
    fuzz: Any, seeds: list[bytes], tmp_path: Path
) -> None:
    table = sys.modules["fuzzing.table"]
    made = table.of_files(tmp_path, "toy", seeds, lambda random, content, other: content, Path.read_bytes)
    toy = table.Reader("toy", lambda folder: made)
    with pytest.raises(AssertionError, match="toy: no seeds, or one that no mutator changes"):
        sys.modules["fuzzing.worker"].Worker(toy, 0, tmp_path).run(0, 10)


@pytest.mark.slow
def test_500_damaged_inputs_of_each_reader_end_in_a_sentence(
    fuzz: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Within two minutes of processor time."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    counts: dict[str, Any] = {}
    fuzz.run(tmp_path, list(fuzz.READERS), counts, 1, 500, 0.0)
    wrong = {name: one.places for name, one in counts.items() if one.places}
    assert not wrong, f"{wrong}; their inputs are in {tmp_path / 'failing'}"
    assert all(
        one.inputs == 500 and (one.refused > 0 or name in ("search vectors", "note of sources"))
        for name, one in counts.items()
    )  # what these two remember is made anew where it is damaged
