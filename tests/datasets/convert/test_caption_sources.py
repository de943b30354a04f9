"""Where captions and splits come from: several files at once, files that are not used, links, subjects."""

from __future__ import annotations

import io
import json
import random
import shutil
from pathlib import Path

import pytest
from bvh_clips import write_source
from rich.console import Console
from typer.testing import CliRunner

from motionloom.datasets.convert.bvh.plan import BvhConfig
from motionloom.datasets.convert.bvh.read import list_files
from motionloom.datasets.convert.captions.collect import Captions
from motionloom.datasets.convert.common.splits import hash_split, subject_of
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.schema import UserError
from motionloom.pipeline.cli.convert import convert_command
from motionloom.pipeline.cli.main import app

NAMES = ("walk_a", "jump", "sub/turn")


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three clips, one of them in a folder, and their joint map."""
    return write_source(tmp_path_factory.mktemp("source"), NAMES)


@pytest.mark.parametrize("seed", range(20))
def test_no_clip_moves_when_subjects_come_and_go(seed: int) -> None:
    """Of random subjects some leave and others come: everyone else stays, all clips of a person together."""
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


def test_clips_that_the_user_moves_are_counted(source: Path, tmp_path: Path) -> None:
    given = {"source": source, "joint_map": source / "map.json", "licence": "CC0-1.0", "splits": "clips:5"}
    out, said = tmp_path / "out", io.StringIO()
    for splits in ("clips:5", "clips:5", "clips:7"):
        said = io.StringIO()
        console = Console(file=said, width=200)
        convert_command("bvh", {**given, "splits": splits}, out, plan=False, workers=1, console=console)
        assert ("to another split" in said.getvalue()) is (splits == "clips:7")
    moved = sum(hash_split(name, 5) != hash_split(name, 7) for name in NAMES)
    assert f"{moved} clips move" in said.getvalue()


def test_captions_of_several_files_count_together(source: Path, tmp_path: Path) -> None:
    """A folder with text, CSV and JSON side by side, and a table whose columns have names of its own."""
    given = tmp_path / "words"
    (given / "deep").mkdir(parents=True)
    (given / "walk_a.txt").write_text("a person walks\n")
    (given / "deep/takes.csv").write_text("file,caption\nturn.bvh,turns around\n")
    (given / "list.json").write_text(json.dumps({"jump": "a person jumps", "elsewhere": "nobody"}))
    (given / "people.csv").write_text("name,age\nanna,30\n")
    german = tmp_path / "takes.csv"
    german.write_text("Datei;Beschreibung;text\nsub/turn.bvh;dreht sich;not this\nwalk_a.bvh;geht;not this\n")
    config = {"source": source, "joint_map": source / "map.json", "licence": "CC0-1.0"}
    captions = [str(given), f"{german}:text=Beschreibung,file=Datei"]
    made = prepare(BvhConfig.parse({**config, "captions": captions}, "x")).plan
    assert not made.stop and "3 of 3 clips have captions in words, takes.csv" in made.captions
    assert {clip.id: [text.text for text in clip.texts] for _, clip in made.items} == {
        "walk_a": ["a person walks", "geht"],
        "turn": ["turns around", "dreht sich"],
        "jump": ["a person jumps"],
    }
    assert any("no captions in people.csv" in note for note in made.notes)
    words = ["data", "convert", "bvh", str(source), str(tmp_path / "out"), "--plan"]
    ran = CliRunner().invoke(app, [*words, *(w for one in captions for w in ("--captions", one))])
    assert ran.exit_code == 0, ran.output
    assert ran.stdout.splitlines()[-1].count("--captions") == 2
    for wrong, told in (
        ("txt=Beschreibung,file=Datei", "did you mean 'text'"),
        ("text=X,file=Datei", "Datei"),
    ):
        with pytest.raises(UserError, match=told):
            Captions.read([Path(f"{german}:{wrong}")])


def test_files_of_captions_that_are_not_used_are_said(source: Path, tmp_path: Path) -> None:
    tree = Path(shutil.copytree(source, tmp_path / "tree"))
    (tree / "jump.txt").write_text("a person jumps\n")
    (tree / "sub/captions.csv").write_text("file,caption\nturn.bvh,turns\n")
    (tree / "sub/notes.csv").write_text("day,hour\n1,2\n")
    (tree / "readme.txt").write_text("by anna\n")

    def unused(*captions: Path) -> str:
        fields = {"source": tree, "joint_map": source / "map.json", "captions": captions}
        notes = prepare(BvhConfig.parse({**fields, "uncaptioned": "keep"}, "x")).plan.notes
        return "".join(note for note in notes if "not used" in note)

    assert unused().startswith("2 files") and ": jump.txt, sub/captions.csv;" in unused()
    assert unused(tree / "sub/captions.csv").startswith("1 files")
    assert not unused(tree)


def test_folders_behind_links_are_read_once(source: Path, tmp_path: Path) -> None:
    tree, outside = Path(shutil.copytree(source, tmp_path / "tree")), tmp_path / "outside"
    (outside / "b").mkdir(parents=True)
    (outside / "b/more.bvh").write_bytes((source / "jump.bvh").read_bytes() + b"\n")
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
