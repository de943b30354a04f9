"""Every reader of outside bytes stands in the fuzzer's table, and answers damaged inputs with a sentence."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from starlette.routing import Route

from motionloom.datasets.convert.common.converter import CONVERTERS
from motionloom.pipeline.serve.app import Site

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
    assert all(row.name == name and row.doors is not None for name, row in fuzz.READERS.items())
    monkeypatch.setitem(CONVERTERS._things, "toy", object)  # type: ignore[arg-type]
    routes = Site.app.fget  # type: ignore[attr-defined]

    def app(site: Site) -> Any:
        made = routes(site)
        made.router.routes.append(Route("/api/toys", site.info, methods=["POST"]))
        return made

    monkeypatch.setattr(Site, "app", property(app))
    monkeypatch.delitem(fuzz.READERS, "checkpoint")
    lacking = fuzz.missing()
    assert len(lacking) >= 3 and "no seeds for the converter toy" in lacking
    assert "no seeds for the request /api/toys" in lacking
    assert any("pipeline/training/checkpointing.py (torch.load" in one for one in lacking)


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
        one.inputs == 500 and one.refused > 0 for name, one in counts.items() if name != "search vectors"
    )
