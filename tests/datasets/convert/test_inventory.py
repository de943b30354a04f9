"""Every entry of a source and every line of its lists ends in one bin, whatever lies between the clips."""

from __future__ import annotations

import os
import re
import shutil
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import release_trees as trees
from amass_clips import as_smplx, save, walk
from bvh_clips import write_clip, write_source

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.printable import printable
from motionloom.datasets.convert.captions.collect import Captions
from motionloom.datasets.convert.common.conversion import Conversion, run_conversion
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.planned import file_of
from motionloom.datasets.convert.registry import converter_named, prepare

SETS = ("motionhub", "finedance", "bones_seed", "motion272", "snapmogen", "beat2", "style100")
QUICK = {"audio_features": False, "sound_rate": 8000}
OPTIONS: dict[str, dict[str, Any]] = {
    "aistpp": {"sound": "none"}, "motionhub": QUICK, "finedance": QUICK, "beat2": QUICK,
    "bvh": {"licence": "CC0-1.0", "uncaptioned": "keep"}, "amass": {"uncaptioned": "keep"},
}  # fmt: skip
NAMES = ("\udc8f", "new\nline", "tab\tname", "back\\slash", "-o", ".hidden", "é", "e\u0301", "ü" * 100)
HOSTILE = ("circle", "up", "outside", "nowhere", "again", "pipe", "socket", "closed", "._mac", *NAMES)


def built(name: str, root: Path, shared: Path) -> Path:
    """A small source of a converter, free to change."""
    if name in SETS:
        return Path(getattr(trees, name)(root))
    if name == "bvh":
        return write_source(root, ["walk", "jump", "sub/turn"])
    if name == "amass":
        for path, clip in (("CMU/01/a_poses", walk(60.0)), ("KIT/3/b_stageii", as_smplx(walk(30.0)))):
            save(root / f"{path}.npz", **clip)
        return root
    return Path(shutil.copytree(shared / f"data/layouts/{name}", root, copy_function=shutil.copyfile))


def spoil(folder: Path, ending: str, outside: Path) -> None:
    """Put one of each hostile entry into a folder."""
    links = {"circle": f"circle{ending}", "nowhere": "gone", "outside": str(outside),
             "up": str(folder.parent), "again": str(folder)}  # fmt: skip
    for name, target in links.items():
        (folder / f"{name}{ending}").symlink_to(target)
    os.mkfifo(folder / f"pipe{ending}")
    with socket.socket(socket.AF_UNIX) as server:
        here = Path.cwd()
        os.chdir(folder)  # a socket's path may have 108 bytes
        server.bind(f"socket{ending}")
        os.chdir(here)
    (folder / f"closed{ending}").mkdir()
    for name in ("._mac", *NAMES):
        (folder / f"{name}{ending}").write_bytes(b"junk")


def entries(folder: Path) -> set[str]:
    """Every entry but folders; of folders behind links the link."""
    found = set()
    for here, folders, names in os.walk(folder):
        place = Path(here)
        links = [name for name in folders if (place / name).is_symlink()]
        found |= {(place / name).relative_to(folder).as_posix() for name in (*names, *links)}
    return found


def require_sums(plan: ConversionPlan[Any]) -> dict[str, int]:
    """Totals of the sums by what they count, of which the parts make up each."""
    totals = {}
    for line in plan.sums:
        count, what, parts = re.fullmatch(r"([\d,]+) (.*?): (.*)", line).groups()  # type: ignore[union-attr]
        totals[what] = int(count)
        assert int(count) == sum(int(part.split()[0]) for part in parts.split(", ") if part != "none"), line
    return totals


@pytest.mark.parametrize("name", ["bvh", "amass", "humanml3d", "motionx", "aistpp", *SETS])
def test_nothing_is_lost_between_hostile_entries(
    name: str, shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = built(name, tmp_path / "source", shared)
    kind = converter_named(name)

    def planned() -> ConversionPlan[Any]:
        return prepare(kind.config_class.parse({"source": source, **OPTIONS.get(name, {})}, name)).plan

    before, real = planned(), Path.iterdir
    assert before.items and require_sums(before)["entries of the source"] == len(entries(source))
    homes = sorted({(source / before.base / file_of(clip)).parent for _, clip in before.items})
    ending = Path(file_of(before.items[0][1])).suffix
    (tmp_path / f"far{ending}").write_bytes(b"junk")
    for home in {source, *homes}:
        spoil(home, ending, tmp_path / f"far{ending}")

    def entries_of(folder: Path) -> Any:  # whoever runs this may read everything
        if folder.stem == "closed":
            raise PermissionError(13, "Permission denied", str(folder))
        return real(folder)

    monkeypatch.setattr(Path, "iterdir", entries_of)
    after = planned()
    assert {clip.id for _, clip in before.items} <= {clip.id for _, clip in after.items}
    for what, total in require_sums(before).items():
        assert what.startswith("entries") or require_sums(after)[what] == total
    told = {one.source.rstrip("/") for one in (*after.left_out(), *after.not_ours)}
    named = {after.base + one for one in told} | told
    clips = {after.base + file_of(clip) for _, clip in after.items}
    odd = {entry for entry in entries(source) if Path(entry).name.removesuffix(ending) in HOSTILE}
    assert len(odd) >= len(HOSTILE) - 1  # a closed folder is none
    odd.discard(f"up{ending}")  # a link to a folder beside the source, whose files are read
    plain = {one.encode("utf-8", "backslashreplace").decode() for one in odd}
    assert plain <= named | clips, plain - named
    # Folders behind links have entries of their own, so at least these are summed.
    closed = sum((home / f"closed{ending}").is_dir() for home in {source, *homes})
    assert require_sums(after)["entries of the source"] >= len(entries(source)) + closed - len(homes) - 1


def test_left_out_names_each_line_and_file(tmp_path: Path) -> None:
    source = write_source(tmp_path / "in", ["walk", "jump", "turn"])
    write_clip(source / "short.bvh", 5, frames=9)
    (source / "gone.bvh").symlink_to("/nowhere/gone.bvh")
    rows = ["sep=;", "name;caption;start;end", "walk;walks;;", 's2/jump;jumps;;', 'turn;"turns" and on;;',
            "turn;turns;0;9", "short;runs;;", "walk;waves;2;1", "none;x;;", "jump;hops;0;1;", ""]  # fmt: skip
    (source / "c.csv").write_text("\n".join(rows))
    for split, names in (("train", "walk\njump\nwalk\nmissing\n"), ("test", "turn\n")):
        (source / f"{split}.txt").write_text(names)
    given = {"source": source, "joint_map": source / "map.json", "captions": source / "c.csv",
             "splits": source, "licence": "CC0-1.0", "uncaptioned": "drop"}  # fmt: skip
    conversion = prepare(converter_named("bvh").config_class.parse(given, "x"))
    totals = require_sums(conversion.plan)
    assert totals == {"entries of the source": 9, "lines of c.csv": 8, "lines of train.txt": 4,
                      "lines of test.txt": 1}  # fmt: skip
    assert "5 left out" in next(line for line in conversion.plan.sums if "c.csv" in line)
    run_conversion(conversion, tmp_path / "out", progress=False)
    listed = [line.split("\t")[1] for line in (tmp_path / "out/left-out.txt").read_text().splitlines()]
    for name in (
        "gone.bvh",
        "short.bvh",
        "c.csv:5",
        "c.csv:6",
        "c.csv:8",
        "c.csv:10",
        "train.txt:3",
        "s2/jump",
        "none",
    ):
        assert name in listed, name


def test_a_folder_that_all_names_share_is_said_once(tmp_path: Path) -> None:
    source = write_source(tmp_path / "in", ["walk", "jump"])
    for names, prefix in ((["s2/walk", "s2/jump"], True), (["s2/walk", "s3/jump"], False)):
        (source / "c.csv").write_text("\n".join(["name,caption", *(f"{name},x" for name in names)]))
        given = {"source": source, "joint_map": source / "map.json", "captions": source / "c.csv"}
        plan = prepare(converter_named("bvh").config_class.parse({**given, "uncaptioned": "keep"}, "x")).plan
        assert sum("'s2/'" in note for note in plan.notes) == prefix
        assert plan.words.captioned == 2 * prefix


@pytest.mark.parametrize("spell", [lambda name: name, str.upper])
def test_spellings_that_look_alike_are_one_name(spell: Callable[[str], str], tmp_path: Path) -> None:
    path = tmp_path / "c.csv"
    path.write_text(spell("name") + ",caption\ne\u0301lan,leaps\n")
    config = converter_named("bvh").config_class.parse({"source": tmp_path, "captions": path}, "x")
    assert list(config.listing(["élan.bvh"]).rows) == ["élan.bvh"]
    with pytest.raises(UserError, match="no captions"):
        path.write_text("name,caption\n")
        Captions.read([path])


@pytest.mark.parametrize("name", ["bvh", "amass", "humanml3d", "motionx", "aistpp", *SETS])
def test_a_plan_is_the_conversion(name: str, shared: Path, tmp_path: Path) -> None:
    """Sums, clips left out with their reasons, frames and doubts, of a source with a damaged file."""
    source = built(name, tmp_path / "source", shared)
    kind = converter_named(name)

    def prepared() -> Conversion[Any]:
        given = {"source": source, "most_rejected": 1, "look": 1, **OPTIONS.get(name, {})}
        return prepare(kind.config_class.parse(given, name))

    before = prepared().plan
    path = source / before.base / file_of(before.items[0][1])
    data = path.read_bytes()
    middle = 2 * len(data) // 3  # of the values, not of the header
    damaged = len({file_of(clip) for _, clip in before.items}) > 1
    if damaged:
        path.write_bytes(data[:middle] + b"\xff" * 16 + data[middle + 16 :])
    plan = prepared().looked().plan
    made = prepared()
    manifest = run_conversion(made, tmp_path / "out", progress=False)
    assert plan.sums == made.plan.sums
    left_out = [*plan.left_out(), *plan.not_ours]
    told = [f"{one.kind}\t{printable(one.source)}\t{printable(one.reason)}" for one in left_out]
    assert set(told) == set((tmp_path / "out/left-out.txt").read_text().splitlines())
    for split, frames in plan.totals.frames.items():
        assert frames == sum(one.frames for one in manifest.shards if one.split == split)
    assert set(manifest.notes) <= set(plan.notes) and len(plan.left_out()) >= damaged
    assert any("file's name" in note for note in plan.notes) is (name == "motionx")
