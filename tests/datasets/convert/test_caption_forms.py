"""Captions as people have them: five forms that give the same data set, and errors that name the place."""

from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from bvh_clips import write_source
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Manifest
from motionloom.datasets.convert.bvh.config import BvhConfig
from motionloom.datasets.convert.captions.collect import Captions
from motionloom.datasets.convert.captions.options import list_clips
from motionloom.datasets.convert.common.splits import hash_split, read_split_files, subject_of
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.pipeline.cli.convert import convert_command

TEXTS = {
    "walk_a": ["a person walks", 'says "hi", then sits'],
    "jump": ["a person jumps, élan"],
    "sub/turn": ["turns # left"],
}
Rows = dict[str, list[str]]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three clips, one of them in a folder, and their joint map."""
    return write_source(tmp_path_factory.mktemp("source"), TEXTS)


def lines(path: Path, rows: Rows, key: str) -> Path:
    if key == "captions":
        records: list[dict[str, Any]] = [{"id": name, "captions": texts} for name, texts in rows.items()]
    else:
        records = [{"file": f"{name}.bvh", key: text} for name, texts in rows.items() for text in texts]
    path = path.with_suffix(".jsonl")
    path.write_text("\n".join(map(json.dumps, records)))
    return path


def json_list(path: Path, rows: Rows) -> Path:
    path = path.with_suffix(".json")
    path.write_text(json.dumps([{"name": name, "captions": texts} for name, texts in rows.items()], indent=1))
    return path


def table(path: Path, rows: Rows, delimiter: str) -> Path:
    path = path.with_suffix(".tsv" if delimiter == "\t" else ".csv")
    out = io.StringIO()
    writer = csv.writer(out, delimiter=delimiter)  # CRLF, as spreadsheets write them
    writer.writerow(["Clip Id" if delimiter == ";" else "File Name", "Caption"])
    writer.writerows(
        [f".\\{name}.bvh".replace("/", "\\"), text] for name, texts in rows.items() for text in texts
    )
    path.write_bytes(out.getvalue().encode("utf-8-sig"))
    return path


def folder(path: Path, rows: Rows) -> Path:
    for name, texts in rows.items():
        file = path / f"{name}.txt"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("\r\n".join(texts) + "\n\n", encoding="utf-8")
    return path


def humanml(path: Path, rows: Rows) -> Path:
    return folder(path, {name: [f"{text}#a/DET#0.0#0.0" for text in texts] for name, texts in rows.items()})


FORMS: dict[str, Callable[[Path, Rows], Path]] = {
    "lines of captions": lambda path, rows: lines(path, rows, "captions"),
    "lines of one caption": lambda path, rows: lines(path, rows, "caption"),
    "JSON list": json_list,
    "CSV": lambda path, rows: table(path, rows, ","),
    "CSV with semicolons": lambda path, rows: table(path, rows, ";"),
    "TSV": lambda path, rows: table(path, rows, "\t"),
    "folder": folder,
    "HumanML3D": humanml,
}


def convert(source: Path, out: Path, captions: Path) -> str:
    """The default command; what it prints."""
    said = io.StringIO()
    fields = {"source": source, "joint_map": source / "map.json", "licence": "CC0-1.0", "captions": captions}
    console = Console(file=said, width=200)
    convert_command("bvh", fields, out, plan=False, workers=1, console=console)
    return said.getvalue()


@pytest.fixture(scope="module")
def expected(source: Path, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Checksums of the shards by the first form."""
    folder = tmp_path_factory.mktemp("expected")
    convert(source, folder / "out", FORMS["lines of captions"](folder / "captions", TEXTS))
    for split in ("train", "val", "test"):
        if list((folder / "out").glob(f"*-{split}-*.tar")):
            dataset = ShardDataset.open(folder / "out", split)  # type: ignore[arg-type]
            for number, name in enumerate(dataset.ids):
                assert [caption.text for caption in dataset.texts(number)] == TEXTS[name]
    return [shard.sha256 for shard in Manifest.load_json(folder / "out/manifest.json").shards]


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_same_data_set(
    form: str, source: Path, tmp_path: Path, expected: list[str]
) -> None:
    captions = FORMS[form](tmp_path / "captions", TEXTS)
    assert "3 of 3 clips" in convert(source, tmp_path / "out", captions)
    if form == "HumanML3D":  # brings tokens, so the shards are not the same bytes
        rows = Captions.read([captions]).rows
        assert {name: [text.text for text in row.texts] for name, row in rows.items()} == TEXTS
        assert [text.tokens for row in rows.values() for text in row.texts] == [["a/DET"]] * 4
        assert all((text.start, text.end) == (0.0, None) for row in rows.values() for text in row.texts)
        return
    shards = Manifest.load_json(tmp_path / "out/manifest.json").shards
    assert [shard.sha256 for shard in shards] == expected


LINE = '{"id": "a", "captions": ["x"]}'
BROKEN = [  # (file, content, line or record, and key)
    ("c.jsonl", LINE + '\n{"id": "b" "caption": "x"}', ":2:"),
    ("c.jsonl", '{"id": "a", "caption": "x", "start": 3, "end": 2}', ":1: 'caption'"),
    ("c.csv", 'name,caption\na,x\nb,"he walks\nc,z\n', ":3:"),
    ("c/a.txt", "walks#a/DET#0.0#0.0\njumps#a/DET#0.0", ":2: 3 of the 4"),
    ("c.jsonl", "é walks\r\nà l".encode() + b"\xe9ger", ":2:"),
    ("c.csv", "name,caption,split\na,x,Validation\nb,y,fold 1", ":3: split 'fold 1'"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "place"), BROKEN)
def test_a_broken_line_is_named(name: str, content: str | bytes, place: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    try:
        bad = Captions.read([path if path.parent == tmp_path else path.parent]).bad
    except UserError as error:  # where no record is good
        bad = [str(error)]
    (sentence,) = bad
    assert sentence.startswith(f"{path}{place}")


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(["lines of captions", "CSV", "JSON list", "folder"]), st.integers(0, 2), st.data())
def test_a_bad_row_is_one_bad_row(
    source: Path, tmp_path: Path, form: str, at: int, data: st.DataObject
) -> None:
    """Whatever stands in place of a row, the others say what they say, and the plan what is wrong with it."""
    path, wrong = FORMS[form](tmp_path / "c", {name: ["good"] for name in TEXTS}), list(TEXTS)[at]
    if form == "folder":
        (path / f"{wrong}.txt").write_bytes(b"\xff\xfe" + data.draw(st.binary(max_size=9)))
    elif form == "JSON list":
        rows = json.loads(path.read_text())
        rows[at] = data.draw(st.none() | st.booleans() | st.just({"name": "../x", "captions": "y"}))
        path.write_text(json.dumps(rows))
    else:
        rows = path.read_text("utf-8-sig").splitlines()
        junk = data.draw(st.text(st.characters(exclude_characters='\0"', max_codepoint=0xFF), max_size=9))
        rows[at + (form == "CSV")] = "{{,,".join(["", *junk.splitlines(), ""])
        path.write_text("\n".join(rows), "utf-8")
    made = plan(source, path, uncaptioned="drop")
    assert sorted(clip.id for _, clip in made.items) == sorted({*TEXTS} - {wrong})
    assert any(note.startswith("1 records of captions cannot be read: ") for note in made.notes)


PATHS = ["amc/01_01.amc", "amc/01_02.amc", "amc/02_09.amc", "more/88_01.amc"]


@pytest.mark.parametrize(
    ("given", "captioned", "timed"),
    [("cmu/cmu_descriptions.json", 4, 0), ("kitml/kitml_annotations.json", 2, 2), ("cmu", 4, 2)],
)
def test_lists_of_whole_collections(given: str, captioned: int, timed: int, shared: Path) -> None:
    """CMU's own descriptions, KIT-ML's sentences by AMASS's path, and a folder of both kinds."""
    listing = BvhConfig(source=shared, captions=shared / "data/real" / given).listing(PATHS)
    assert (len(listing.rows), listing.missing) == (captioned, {}) and len(listing.unused) > 700
    texts = {path: row.texts for path, row in listing.rows.items()}
    ends = [text.end for text in texts["amc/01_01.amc"] + texts["amc/02_09.amc"] if text.end is not None]
    assert ends == [22.925, 8.608][:timed]
    assert all(text.text for row in texts.values() for text in row)


def test_mirrored_sentences_and_names_that_fit_twice_are_left_alone(tmp_path: Path) -> None:
    entry = {
        "path": "KIT/3/walk_poses",
        "annotations": [{"seg_id": "x", "text": "walks", "start": 0, "end": 1}],
    }
    mirrored = {**entry, "path": "M/KIT/3/walk_poses", "annotations": [{"text": "mirrored"}]}
    (tmp_path / "c.json").write_text(json.dumps({"00001": entry, "M00001": mirrored}))
    config = BvhConfig(source=tmp_path, captions=tmp_path / "c.json")
    for paths in (["KIT/3/walk_poses.npz", "KIT/4/walk_poses.npz"], ["3/walk.bvh"], ["x/walk.bvh"]):
        (row,) = config.listing(paths).rows.values()
        assert [text.text for text in row.texts] == ["walks"]
    assert not config.listing(["a/walk.bvh", "b/walk.bvh"]).rows


@pytest.mark.parametrize(
    ("name", "subject"),
    [
        ("h/HDM_bd_kickLFront1Reps_003_120.amc", "HDM_bd"),
        ("CMU/07/07_12_poses.npz", "07"),
        ("mocap/walk_fast_001.bvh", "mocap"),
        ("anna-waves.bvh", "anna"),
        ("12.bvh", "12"),
    ],
)
def test_names_of_files_tell_the_subject(name: str, subject: str) -> None:
    assert subject_of(name) == subject


def test_captions_with_times_other_keys_and_several_columns(tmp_path: Path) -> None:
    path = tmp_path / "c.csv"
    path.write_text(
        "Caption_2;take;file;fps;Caption 1;split;start;end\n"
        "walks;7;C:\\mocap\\a.bvh;120;goes;Valid;0.5;2\n"
        ";8;b.bvh;;;;;\n"
    )
    rows = Captions.read([path]).rows
    a = rows["a"]
    assert [(c.text, c.start, c.end, c.source) for c in a.texts] == [
        ("walks", 0.5, 2.0, "captions"),
        ("goes", 0.5, 2.0, "captions"),
    ]
    assert (a.split, a.file) == ("val", "C:/mocap/a.bvh")
    assert rows["b"].texts == () and rows["b"].split is None
    path = tmp_path / "c.jsonl"
    path.write_text(
        '{"id": 7, "text": "x", "start": 1}\n{"id": 7, "text": "y", "take": 3}\n{"id": 7, "text": "y"}'
    )
    assert [(c.text, c.start) for c in Captions.read([path]).rows["7"].texts] == [("x", 1.0), ("y", 0.0)]
    path.write_text('{"id": "a", "text": "x", "split": "dev"}\n{"id": "a", "text": "y", "split": "test"}')
    (bad,) = Captions.read([path]).bad
    assert re.search(r":2: .*'a'.*'test'.*'val'.*:1", bad)


def test_names_of_clips_find_their_files(tmp_path: Path) -> None:
    def found(names: list[str], paths: list[str]) -> dict[str, str]:
        rows = Captions.read([lines(tmp_path / "c", {name: ["x"] for name in names}, "captions")]).rows
        listing = list_clips(paths, rows.values(), None, [])
        return {path: row.id for path, row in listing.rows.items()}

    assert found(["a"], ["x/a.bvh"]) == {"x/a.bvh": "a"}
    assert found(["mocap/x/a"], ["x/a.bvh", "y/a.bvh"]) == {"x/a.bvh": "mocap/x/a"}
    assert found(["raw/a"], ["clean/a.bvh"]) == {}, "another folder is another clip"
    assert found(["take.001"], ["take.001.bvh"]) == {"take.001.bvh": "take.001"}
    assert found(["x/a", "q/x/a"], ["x/a.bvh"]) == {"x/a.bvh": "x/a"}, "another folder's is another clip"
    assert found(["s2/walk", "s1/walk"], ["walk.bvh"]) == {}
    assert found(["a", "x/a"], ["x/a.bvh"]) == {"x/a.bvh": "x/a"}


def test_split_files_name_clips_as_captions_do(source: Path, tmp_path: Path) -> None:
    (tmp_path / "train.txt").write_text("walk_a.bvh\nturn\n")
    (tmp_path / "val.txt").write_text("jump\n")
    made = plan(source, None, splits=tmp_path)
    assert {clip.id: split for split, clip in made.items} == {
        "walk_a": "train",
        "sub/turn": "train",
        "jump": "val",
    }
    for content, said in (("", "no ids in it"), ("hop\n", "none of its clips is in the source")):
        (tmp_path / "val.txt").write_text(content)
        with pytest.raises(UserError, match=rf"val\.txt: {said}"):
            plan(source, None, splits=tmp_path)
    (tmp_path / "val.txt").write_text("jump\nsub/turn\nhop\n")
    with pytest.raises(UserError, match=r"'sub/turn'.*val\.txt.*sub/turn\.bvh.*train\.txt"):
        plan(source, None, splits=tmp_path)


def plan(source: Path, captions: Path | None, **changes: Any) -> Any:
    given = {"source": source, "joint_map": source / "map.json", "captions": captions, "licence": "CC0-1.0"}
    return prepare(BvhConfig.parse({**given, **changes}, "options")).plan


def test_clips_without_captions_stop_the_conversion_until_it_is_decided(source: Path, tmp_path: Path) -> None:
    path = tmp_path / "c.csv"
    path.write_text("name,caption\nwalk_a,walks\njumps,jumps\n")
    made = plan(source, path)
    for part in ("1 of 3 clips", "c.csv", "(jump.bvh, sub/turn.bvh)", "('jumps', nearest: jump.bvh)"):
        assert part in made.words.summary
    assert made.words.summary in made.notes and len(made.words.uncaptioned) == 2
    shown = "".join(str(cell) for column in made.table().columns for cell in column.cells)
    assert "2 of 3 clips" in shown
    with pytest.raises(UserError, match=r"c\.csv: .*2 of 3.*\(jump\.bvh,.*turn\.bvh\)"):
        made.require_settled()
    with pytest.raises(UserError, match=r"nearest: jump\.bvh.*uncaptioned"):
        convert(source, tmp_path / "out", path)
    assert not list((tmp_path / "out").glob("*.tar"))
    for choice, count in (("drop", 1), ("keep", 3)):
        settled = plan(source, path, uncaptioned=choice)
        settled.require_settled()
        assert sum(settled.counts().values()) == count
        assert ("kept" if choice == "keep" else "left out") in settled.words.summary


def test_split_files_by_other_names(tmp_path: Path) -> None:
    for name in ("Train", "valid", "crossmodal_testing", "fold1", "all"):
        (tmp_path / f"{name}.txt").write_text(f"in {name}\n")
    splits = read_split_files(tmp_path).splits
    assert splits == {"in Train": "train", "in valid": "val", "in crossmodal_testing": "test"}
    counts = Counter(hash_split(f"clip {number}") for number in range(20_000))
    assert counts["train"] / 20_000 == pytest.approx(0.80, abs=0.01)
    assert counts["val"] / 20_000 == pytest.approx(0.05, abs=0.005)
    (tmp_path / "dev.txt").write_text("in Train\n")
    with pytest.raises(UserError, match=r"'in Train'.*Train\.txt"):
        read_split_files(tmp_path)
