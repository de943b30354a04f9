"""`where`: what an expression chooses, and what is said of one that cannot be read."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import pytest

from motionloom.datasets.convert.amass.convert import AmassConfig
from motionloom.datasets.convert.common.facts import parse_where, require_known
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.schema import UserError

FACTS: dict[str, Any] = {
    "category": "Dance and Music", "seconds": 12.5, "is_mirror": "False", "task": ("text", "dance"),
    "age": "31",
}  # fmt: skip


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("", True),
        ("seconds<30", True),
        ("seconds <= 12.5 and seconds >= 12.5", True),
        ("seconds>12.5", False),
        ("age=31.0", True),
        ("age<9", False),  # by number, not by letter
        ("category=dance AND music AND seconds<30", True),
        ("category='dance and music' and seconds<30", True),
        ('category!="dance and music"', False),
        ("is_mirror=false", True),
        ("task=dance and task!=walk", True),
        ("category<3", False),
        ("unknown=1", False),
    ],
)
def test_conditions(text: str, holds: bool) -> None:
    assert all(condition.holds(FACTS) for condition in parse_where(text)) == holds


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("seconds", "'seconds' is no condition"),
        ("seconds<", "'seconds<' is no condition"),
        ("seconds<30 or age=3", "is no condition"),
        ("seconds<30 and", "'' is no condition"),
        ("__import__('os')", "is no condition"),
        ("a=1 and b==2", "'b==2' is no condition"),
        ("a=1 b=2", "is no condition"),
    ],
)
def test_what_cannot_be_read_is_quoted(text: str, said: str) -> None:
    with pytest.raises(UserError, match=said.replace("(", r"\(")):
        parse_where(text)


def test_every_source_has_it_and_unknown_names_are_answered_with_those_there_are(
    amass: ModuleType, tmp_path: Any
) -> None:
    for name, seconds in (("long", 3.0), ("short", 2.0)):
        amass.save(tmp_path / f"in/CMU/01/{name}_poses.npz", **amass.walk(60.0, seconds))
    plan = prepare(AmassConfig(source=tmp_path / "in", where="subset=cmu and seconds>2.5")).plan
    assert [clip.id for _, clip in plan.items] == ["CMU/01/long_poses"]
    assert ["seconds>2.5" in drop.reason for drop in plan.dropped] == [True]
    with pytest.raises(UserError, match="where: 'seconds'"):
        AmassConfig.parse({"source": str(tmp_path), "where": "seconds"}, "options")
    with pytest.raises(UserError, match=r"'sceonds'.* category, seconds"):
        require_known("sceonds<3", ["seconds", "category"])
