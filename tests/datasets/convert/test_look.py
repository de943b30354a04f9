"""A look at a source before its conversion: what real clips show, and what makes people of wrong figures."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bvh_clips import unpack_bandai

from motionloom.datasets.check.dataset import examine
from motionloom.datasets.convert.bvh.convert import BvhConfig
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.common.look import MOST_CLIPS, Look, SourceJoints, look_at
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.schema import Manifest, UserError


@pytest.fixture(scope="module")
def source(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven real clips in two folders, one of 0.67 s, and their joint map."""
    folder = tmp_path_factory.mktemp("source")
    for number, path in enumerate(unpack_bandai(shared, folder).values()):
        place = folder / ("one" if number < 3 else "two")
        place.mkdir(exist_ok=True)
        path.rename(place / path.name)
    shutil.copy(shared / "data/bandai/joint_map.json", folder)
    return folder


def config(source: Path, **changes: Any) -> BvhConfig:
    given: dict[str, Any] = {
        "source": source,
        "joint_map": source / "joint_map.json",
        "licence": "CC-BY-NC-4.0",
    }
    return BvhConfig(**(given | changes))


def with_map(source: Path, folder: Path, change: Callable[[list[list[Any]]], None]) -> Path:
    """The joint map with other rows."""
    data = json.loads((source / "joint_map.json").read_text())
    change(data["smpl22"])
    path = folder / "map.json"
    path.write_text(json.dumps(data))
    return path


def swap_sides(rows: list[list[Any]]) -> None:
    names = [row[1] for row in rows]
    old = {row[1]: row[2] for row in rows}
    for row, name in zip(rows, names, strict=True):
        other = name.replace("left", "RIGHT").replace("right", "left").replace("RIGHT", "right")
        row[2] = old[other]


def look(source: Path, **changes: Any) -> Look:
    seen = prepare(config(source, **changes)).look()
    assert seen is not None
    return seen


def said(seen: Look) -> list[str]:
    return [str(suggestion) for suggestion in seen.suggestions]


def convert(given: BvhConfig, out: Path, **options: Any) -> Manifest:
    return run_conversion(prepare(given), out, progress=False, **options)


def test_real_people_are_seen_as_they_are(source: Path) -> None:
    seen = look(source, look=2)
    assert (seen.problems, seen.warnings, seen.suggestions) == ((), (), ())
    assert [(s.name, s.clips, s.unreadable, s.upright, s.head) for s in seen.subsets] == [
        ("one", 2, 0, 2, "+y"),
        ("two", 2, 0, 2, "+y"),
    ]
    for subset in seen.subsets:
        assert subset.height == pytest.approx(1.55, abs=0.01) and subset.fps == (30.0,)
        assert subset.above_floor is not None and 0 <= subset.above_floor < 0.1
    assert seen.clips == 4 and seen.all_subsets == 2
    assert prepare(config(source, look=0)).look() is None
    assert "look" not in config(source).options()


@pytest.mark.parametrize(
    ("changes", "problem", "suggestions"),
    [
        ({"up": "z"}, r"5 of 5 clips \(100%\)", ["--set up=y"]),
        ({"unit": "m"}, r"median 155 m", ["--set unit=cm"]),
        ({"unit": "inch"}, r"median 3\.9\d m", ["--set unit=cm"]),
        ({"unit": "mm", "up": "z"}, r"median 0.155 m", ["--set up=y", "--set unit=cm"]),
    ],
)
def test_wrong_unit_and_axis_are_named(
    source: Path, changes: dict[str, Any], problem: str, suggestions: list[str]
) -> None:
    seen = look(source, look=5, limit=5, **changes)
    assert re.search(problem, " ".join(seen.problems))
    assert [suggestion.split(" (")[0] for suggestion in said(seen)] == suggestions
    with pytest.raises(UserError, match=re.escape(suggestions[-1])):
        seen.require_people("here")


def test_left_for_right_is_seen_by_the_feet(source: Path, tmp_path: Path) -> None:
    seen = look(source, joint_map=with_map(source, tmp_path, swap_sides))
    assert "backwards" in seen.problems[0]
    assert [line.split(":")[0] for line in said(seen)] == ["in the joint map"]


def test_a_floating_source_is_refused_and_a_floating_set_fails_the_check(
    source: Path, tmp_path: Path
) -> None:
    given = config(source, up="z")
    with pytest.raises(UserError, match=r"--set up=y.*--set look=0$"):
        convert(given, tmp_path / "out")
    assert not list((tmp_path / "out").glob("*.tar"))
    convert(given.model_copy(update={"look": 0}), tmp_path / "out")
    report = examine(tmp_path / "out")
    assert list(report.error_kinds.values()) == [1]
    assert "6 of 6 clips" in str(report.errors[0])


def test_few_clips_of_many_subsets_are_chosen(source: Path) -> None:
    joints = np.zeros((3, 22, 3))
    asked: list[int] = []

    def see(number: int) -> SourceJoints:
        asked.append(number)
        return SourceJoints(joints, 30.0)

    def seen(count: int, subsets: int) -> Look:
        asked.clear()
        return look_at(
            range(1000),
            see,
            lambda number: str(number % subsets),
            ConvertConfig(source=source, name="x", layout="body133", fps=20, look=count),
            label=str,
        )

    assert seen(2, 3).clips == 6 and asked != [0, 3, 1, 4, 2, 5]
    many = seen(5, 400)
    assert (many.clips, len(many.subsets), many.all_subsets) == (MOST_CLIPS, MOST_CLIPS, 400)
    assert seen(5, 40).clips == 80
