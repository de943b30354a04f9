"""`docs/architecture.md` quotes the stage that the tests run, and its tables name what the contract has."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from motionloom.pipeline.contract.registry import stage_kinds
from motionloom.pipeline.contract.stage import Every, StageKind
from motionloom.pipeline.stages.trained import TrainedStage

ROOT = Path(__file__).resolve().parents[3]
TEXT = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
SOURCE = (ROOT / "tests" / "helpers" / "pacer_stage.py").read_text(encoding="utf-8")


def section(title: str) -> str:
    return TEXT.split(f"## {title}\n")[1].split("\n## ")[0]


QUOTES = re.findall(r"^```python\n(.*?)^```$", section("A new stage"), re.M | re.S)


@pytest.mark.parametrize("quote", QUOTES, ids=lambda quote: quote.split("(")[0].split()[-1])
def test_the_walk_quotes_the_file(quote: str) -> None:
    """Line for line and in order; `...` leaves lines out."""
    rest = SOURCE.splitlines()
    for line in quote.splitlines():
        if line.strip() in {"", "..."}:
            continue
        assert line in rest, f"not in pacer_stage.py, or not behind the line before: {line}"
        rest = rest[rest.index(line) + 1 :]


def test_there_are_quotes() -> None:
    assert len(QUOTES) == 5


def test_every_answer_is_in_the_tables() -> None:
    text = section("What a stage answers")
    for kind in (StageKind, TrainedStage):
        own = {name for name in vars(kind) if not name.startswith("_") and callable(getattr(kind, name))}
        missing = own - {"roles", "settle", "dry_module"} - set(re.findall(r"`(\w+)`", text))
        assert not missing, f"{kind.__name__}: {missing} are not in docs/architecture.md"


def test_the_inputs_of_every_kind_are_in_the_table() -> None:
    rows = dict(re.findall(r"^\| `(\w+)` \| [^|]+ \| ?([^|]*?) ?\|$", section("Stages"), re.M))
    for name, kind in stage_kinds().items():
        takes = [one if isinstance(one, str) else f"every {one.gives}" for one in kind.takes]
        assert rows[name] == ", ".join(takes), name
    assert any(isinstance(one, Every) for kind in stage_kinds().values() for one in kind.takes)
