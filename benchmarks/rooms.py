"""The rooms of a checkout in figures: what is at the top of each folder, the arrows between, the circles.

A room is what stands at the top of `datasets/`, `models/` or `pipeline/`: a folder, or a file that lies there
alone. An arrow goes from a room to another that one of its files imports from, inside functions too.

    python benchmarks/rooms.py                     # this checkout
    python benchmarks/rooms.py ../older . --clip   # two beside each other, and the way of a clip in both

With `--clip` one BVH file is converted to shards and the shards to their page, in one process, while all
calls are watched. The longest way is the stack of calls that changes rooms most often.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

FOLDERS = ("datasets", "models", "pipeline")
HELPERS = Path(__file__).resolve().parents[1] / "tests" / "helpers"
Arrows = Mapping[str, set[str]]


def modules(root: Path) -> dict[str, Path]:
    """Module -> path relative to the checkout."""
    out = {}
    for folder in (*FOLDERS, "configs"):
        for path in sorted((root / folder).rglob("*.py")):
            relative = path.relative_to(root)
            parts = relative.with_suffix("").parts
            out[".".join(("motionloom", *(parts[:-1] if parts[-1] == "__init__" else parts)))] = relative
    return out


def file_arrows(root: Path) -> dict[str, set[str]]:
    """File -> files of ours that it imports."""
    known = modules(root)
    out = {}
    for path in known.values():
        names = set()
        for node in ast.walk(ast.parse((root / path).read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    full = f"{node.module}.{alias.name}"
                    names.add(full if full in known else node.module)
        out[str(path)] = {str(known[name]) for name in names & known.keys()} - {str(path)}
    return out


def room(path: str | Path) -> str:
    """`datasets/motion` of `datasets/motion/bvh.py`, `pipeline/graph` of `pipeline/graph.py`."""
    return "/".join(Path(path).with_suffix("").parts[:2])


def between(arrows: Arrows) -> dict[str, set[str]]:
    """Arrows between rooms of arrows between files."""
    out: dict[str, set[str]] = {}
    for path, targets in arrows.items():
        out.setdefault(room(path), set()).update({room(t) for t in targets} - {room(path)})
    return out


def reached(arrows: Arrows, start: str) -> set[str]:
    """All that `start` reaches by one arrow or more."""
    out: set[str] = set()
    todo = list(arrows.get(start, ()))
    while todo:
        name = todo.pop()
        if name not in out:
            out.add(name)
            todo += arrows.get(name, ())
    return out


def circles(arrows: Arrows) -> list[set[str]]:
    """Groups that reach each other."""
    reach = {name: reached(arrows, name) for name in arrows}
    groups = {frozenset(n for n in reach[name] if name in reach.get(n, ())) for name in arrows}
    return [set(group) for group in groups if len(group) > 1]


def floors(arrows: Arrows) -> int:
    """Rooms on the longest chain of arrows; those of a circle are one floor."""
    whole = {name: min(group) for group in circles(arrows) for name in group}
    one = {name: {whole.get(t, t) for t in targets} for name, targets in arrows.items()}
    known: dict[str, int] = {}

    def height(name: str) -> int:
        if name not in known:
            members = [n for n in arrows if whole.get(n, n) == name]
            below = {t for member in members for t in one[member]} - {name}
            known[name] = 1 + max(map(height, below), default=0)
        return known[name]

    return max(height(whole.get(name, name)) for name in arrows)


def figures(root: Path) -> dict[str, Any]:
    """Row of the table -> figure."""
    files = file_arrows(root)
    rooms = between(files)
    out: dict[str, Any] = {}
    for folder in FOLDERS:
        inside = {name: {t for t in rooms[name] if t.startswith(folder)} for name in rooms}
        own = {name: to for name, to in inside.items() if name.startswith(folder) and "__init__" not in name}
        out[f"{folder}/: rooms"] = len(own)
        out[f"{folder}/: arrows between them"] = sum(map(len, own.values()))
        out[f"{folder}/: floors"] = floors(own)
    out["circles of rooms"] = _named(circles(rooms))
    out["circles of files"] = _named(circles(files))
    lengths = sorted(len((root / path).read_text(encoding="utf-8").splitlines()) for path in files)
    out["files; median and longest, lines"] = f"{len(files)}; {lengths[len(lengths) // 2]}, {lengths[-1]}"
    return out


def _named(groups: Iterable[set[str]]) -> str:
    found = sorted((sorted(group) for group in groups), key=len)
    return f"{len(found)}: " + "; ".join(", ".join(group) for group in found) if found else "0"


TRACED = """
import json, sys
from pathlib import Path
root, folder, out = map(Path, sys.argv[1:4])
try:
    from motionloom.pipeline.cli.main import main
except ImportError:
    from motionloom.pipeline.cli import main
from bvh_clips import write_clip, write_map
from rooms import room
(folder / "files").mkdir()
write_clip(folder / "files" / "walk.bvh", seed=0)
write_map(folder / "map.json")
best, used = [], set()
prefix = str(root) + "/"

def watch(frame, event, argument):
    global best
    if event != "call" or not frame.f_code.co_filename.startswith(prefix):
        return
    way, at = [], frame
    while at is not None:
        name = at.f_code.co_filename
        if name.startswith(prefix) and at.f_code.co_name != "<module>":
            here = room(name.removeprefix(prefix))
            if not way or way[-1] != here:
                way.append(here)
        at = at.f_back
    if frame.f_code.co_name != "<module>":
        used.add(frame.f_code.co_filename.removeprefix(prefix))
    if len(way) > len(best):
        best = way[::-1]

for words in (
    ["convert", "bvh", folder / "files", folder / "shards", "--joint-map", folder / "map.json",
     "--licence", "CC0-1.0", "--unit", "cm", "--workers", 1],
    ["report", folder / "shards", "--out", folder / "page.html"],
):
    sys.argv = ["motionloom", "data", *map(str, words)]
    sys.setprofile(watch)
    try:
        main()
    except SystemExit as stop:
        assert not stop.code, stop.code
    finally:
        sys.setprofile(None)
assert (folder / "page.html").is_file()
out.write_text(json.dumps({"way": best, "files": sorted(used)}))
"""


def way_of_a_clip(root: Path) -> dict[str, Any]:
    """Rooms that the longest stack of calls passes, and files that are used."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "path" / "motionloom").mkdir(parents=True)
        for name in (*FOLDERS, "configs"):
            (place / "path" / "motionloom" / name).symlink_to(root / name)
        given = {"PYTHONPATH": os.pathsep.join(map(str, (place / "path", HELPERS, Path(__file__).parent)))}
        script, work, out = TRACED, place / "work", place / "out.json"
        work.mkdir()
        # Files are named by the links they were imported through.
        at = place / "path" / "motionloom"
        words = [sys.executable, "-P", "-c", script, str(at), str(work), str(out)]
        subprocess.run(words, env={**os.environ, **given}, check=True, stdout=subprocess.DEVNULL, timeout=580)
        found = json.loads(out.read_text())
    return {
        "a clip from BVH to page: rooms on the longest way": len(found["way"]),
        "the longest way": " > ".join(found["way"]),
        "a clip from BVH to page: files used": len(found["files"]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("checkouts", nargs="*", type=Path, default=[Path(__file__).resolve().parents[1]])
    parser.add_argument("--clip", action="store_true", help="watch a clip go from BVH to its page")
    options = parser.parse_args()
    columns = []
    for root in (path.resolve() for path in options.checkouts):
        columns.append(figures(root) | (way_of_a_clip(root) if options.clip else {}))
    print("| | " + " | ".join(path.resolve().name for path in options.checkouts) + " |")
    print("|---" * (len(columns) + 1) + "|")
    for row in columns[0]:
        print(f"| {row} | " + " | ".join(str(column[row]) for column in columns) + " |")


if __name__ == "__main__":
    main()
