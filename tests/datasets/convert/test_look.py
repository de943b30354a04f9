"""A look at a source before its conversion: what real clips show, and what makes people of wrong figures."""

from __future__ import annotations

import io
import json
import random
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bvh_clips import unpack_bandai, write_source
from rich.console import Console
from typer.testing import CliRunner

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Manifest
from motionloom.datasets.check.dataset import examine
from motionloom.datasets.convert.bvh.convert import BvhConfig
from motionloom.datasets.convert.bvh.read import list_files
from motionloom.datasets.convert.captions.collect import Captions
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.common.look import MOST_CLIPS, Look, SourceJoints, look_at
from motionloom.datasets.convert.common.splits import hash_split, subject_of
from motionloom.datasets.convert.registry import prepare
from motionloom.pipeline.cli.convert import convert_command
from motionloom.pipeline.cli.main import app


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
    assert [(s.name, s.clips, s.upright, s.head) for s in seen.subsets] == [
        ("one", 2, 2, "+y"),
        ("two", 2, 2, "+y"),
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


# Where captions and splits come from: several files at once, files that are not used, links, subjects.

NAMES = ("walk_a", "jump", "sub/turn")


@pytest.fixture(scope="module")
def captioned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three clips, one of them in a folder, and their joint map."""
    return write_source(tmp_path_factory.mktemp("captioned"), NAMES)


@pytest.mark.parametrize("seed", range(20))
def test_no_clip_moves_when_subjects_come_and_go(seed: int) -> None:
    """Some random subjects leave and others come: everyone else stays, all clips of a person together."""
    draw = random.Random(seed)
    config = BvhConfig(source=Path("x"), splits=Path(draw.choice(["subjects", "subjects:7", "clips:2"])))

    def splits_of(subjects: list[int]) -> dict[str, str]:
        paths = [f"{subject:03}_{trial:02}.amc" for subject in subjects for trial in range(1 + subject % 5)]
        draw.shuffle(paths)
        listing = config.listing(paths)
        return {path: listing.split_of(path) for path in paths}

    everyone = list(range(120))
    before, after = (splits_of(draw.sample(everyone, draw.randint(1, 120))) for _ in range(2))
    assert {path: after[path] for path in before.keys() & after} == {
        path: before[path] for path in before.keys() & after
    }
    if "subjects" in str(config.splits):
        assert len({(subject_of(path), split) for path, split in before.items()}) == len(
            set(map(subject_of, before))
        )


def test_empty_splits_are_said() -> None:
    listing = BvhConfig(source=Path("x"), splits=Path("subjects")).listing(["p1/a.bvh", "p2/a.bvh"])
    assert "val or test" in listing.empty_splits(dict.fromkeys(["p1/a.bvh", "p2/a.bvh"], "train"))[0]


def test_clips_that_the_user_moves_are_counted(captioned: Path, tmp_path: Path) -> None:
    given = {
        "source": captioned,
        "joint_map": captioned / "map.json",
        "licence": "CC0-1.0",
        "splits": "clips:5",
    }
    out, said = tmp_path / "out", io.StringIO()
    for splits in ("clips:5", "clips:5", "clips:7"):
        said = io.StringIO()
        console = Console(file=said, width=200)
        convert_command("bvh", {**given, "splits": splits}, out, plan=False, workers=1, console=console)
        assert ("to another split" in said.getvalue()) is (splits == "clips:7")
    moved = sum(hash_split(name, 5) != hash_split(name, 7) for name in NAMES)
    assert f"{moved} clips move" in said.getvalue()


def test_captions_of_several_files_count_together(captioned: Path, tmp_path: Path) -> None:
    """A folder with text, CSV and JSON side by side, and a table whose columns have names of its own."""
    given = tmp_path / "words"
    (given / "deep").mkdir(parents=True)
    (given / "walk_a.txt").write_text("a person walks\n")
    (given / "deep/takes.csv").write_text("file,caption\nturn.bvh,turns around\n")
    (given / "list.json").write_text(json.dumps({"jump": "a person jumps", "elsewhere": "nobody"}))
    (given / "people.csv").write_text("name,age\nanna,30\n")
    german = tmp_path / "takes.csv"
    german.write_text("Datei;Beschreibung;text\nsub/turn.bvh;dreht sich;not this\nwalk_a.bvh;geht;not this\n")
    config = {"source": captioned, "joint_map": captioned / "map.json", "licence": "CC0-1.0"}
    captions = [str(given), f"{german}:text=Beschreibung,file=Datei"]
    made = prepare(BvhConfig.parse({**config, "captions": captions}, "x")).plan
    assert not made.stop and "3 of 3 clips have captions in words, takes.csv" in made.words.summary
    assert {clip.id: [text.text for text in clip.texts] for _, clip in made.items} == {
        "walk_a": ["a person walks", "geht"],
        "turn": ["turns around", "dreht sich"],
        "jump": ["a person jumps"],
    }
    assert any("no captions in people.csv" in note for note in made.notes)
    words = ["data", "convert", "bvh", str(captioned), str(tmp_path / "out"), "--plan"]
    ran = CliRunner().invoke(app, [*words, *(w for one in captions for w in ("--captions", one))])
    assert ran.exit_code == 0, ran.output
    assert ran.stdout.splitlines()[-1].count("--captions") == 2
    for wrong, told in (
        ("txt=Beschreibung,file=Datei", "did you mean 'text'"),
        ("text=X,file=Datei", "Datei"),
    ):
        with pytest.raises(UserError, match=told):
            Captions.read([Path(f"{german}:{wrong}")])


def test_files_of_captions_that_are_not_used_are_said(captioned: Path, tmp_path: Path) -> None:
    tree = Path(shutil.copytree(captioned, tmp_path / "tree"))
    (tree / "jump.txt").write_text("a person jumps\n")
    (tree / "sub/captions.csv").write_text("file,caption\nturn.bvh,turns\n")
    (tree / "sub/notes.csv").write_text("day,hour\n1,2\n")
    (tree / "readme.txt").write_text("by anna\n")

    def unused(*captions: Path) -> str:
        fields = {"source": tree, "joint_map": captioned / "map.json", "captions": captions}
        notes = prepare(BvhConfig.parse({**fields, "uncaptioned": "keep"}, "x")).plan.notes
        return "".join(note for note in notes if "not used" in note)

    assert unused().startswith("2 files") and ": jump.txt, sub/captions.csv;" in unused()
    assert unused(tree / "sub/captions.csv").startswith("1 files")
    assert not unused(tree)


def test_folders_behind_links_are_read_once(captioned: Path, tmp_path: Path) -> None:
    tree, outside = Path(shutil.copytree(captioned, tmp_path / "tree")), tmp_path / "outside"
    (outside / "b").mkdir(parents=True)
    (outside / "b/more.bvh").write_bytes((captioned / "jump.bvh").read_bytes() + b"\n")
    for name, target in (
        ("a", outside),
        ("c", outside / "b"),
        ("d", tree / "sub"),
        ("sub/up", tree),
        ("x", tree / "y"),
    ):
        (tree / name).symlink_to(target, target_is_directory=True)
    (outside / "b/round").symlink_to(outside, target_is_directory=True)
    assert list_files(tree)[1] == ["a/b/more.bvh", "jump.bvh", "sub/turn.bvh", "walk_a.bvh"]
