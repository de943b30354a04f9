"""The size and shape of the code in figures, each with the most that it may be.

    python benchmarks/house.py                  # this checkout, figure by figure
    python benchmarks/house.py --lower          # lower the limits of docs/architecture.md to today's figures
    python benchmarks/house.py --small --prose          # the files behind a figure, also --chain

A room is a folder at the top of `datasets/`, `models/` or `pipeline/`. A chain is a file, a file that it
imports, and so on; imports inside functions count. The limits stand in `docs/architecture.md` between two
markers; a test holds them. Who raises one says in the commit what it buys.
"""

from __future__ import annotations

import argparse
import ast
import re
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "architecture.md"
SOURCE = ("datasets", "models", "pipeline", "configs")
CODE = (".py", ".js", ".css", ".html")
UNCOUNTED = ("__pycache__", "__init__.py", "__init__.pyi", "py.typed")
MARKERS = ("<!-- house -->", "<!-- /house -->")


def files(*folders: str, suffixes: tuple[str, ...] = (".py",)) -> list[Path]:
    """Files of these folders with one of the suffixes, sorted."""
    found = (path for folder in folders for path in (ROOT / folder).rglob("*"))
    return sorted(path for path in found if path.suffix in suffixes and "__pycache__" not in path.parts)


def tracked(*patterns: str) -> list[Path]:
    """Files that git tracks, or would, by these patterns; where there is no git, those of the folder."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "--", *patterns]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode == 0 and listed.stdout:
        found = {ROOT / name for name in listed.stdout.splitlines()}
    else:
        found = {path for pattern in patterns for path in ROOT.rglob(pattern.split("/")[-1])}
        tops = {pattern.split("/")[0] for pattern in patterns if "/" in pattern}
        found = {path for path in found if not tops or path.relative_to(ROOT).parts[0] in tops}
    return sorted(path for path in found if path.is_file())


def lines(paths: list[Path]) -> int:
    """Lines of text of all files together."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def source() -> list[Path]:
    """The sources that the budget counts: Python and the pages' JavaScript."""
    return tracked("pipeline/*.py", "datasets/*.py", "models/*.py", "pipeline/*.js")


def lines_of_rooms() -> dict[str, int]:
    """Room -> lines of its sources; what lies at the top of a folder counts as `pipeline/*`."""
    out: dict[str, int] = {}
    for path in source():
        top, *rest = path.relative_to(ROOT).parts
        room = f"{top}/{rest[0]}" if len(rest) > 1 else f"{top}/*"
        out[room] = out.get(room, 0) + lines([path])
    return dict(sorted(out.items()))


def imports() -> dict[Path, set[Path]]:
    """File -> files of ours that it imports."""
    modules = {}
    for path in files(*SOURCE):
        parts = path.relative_to(ROOT).with_suffix("").parts
        modules[".".join(("motionloom", *(parts[:-1] if parts[-1] == "__init__" else parts)))] = path
    out = {}
    for path in modules.values():
        names = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                full = {alias.name: f"{node.module}.{alias.name}" for alias in node.names}
                names |= {full[name] if full[name] in modules else node.module for name in full}
        out[path] = {modules[name] for name in names & modules.keys()} - {path}
    return out


def longest_chain() -> list[Path]:
    """Files on the longest chain of imports, the importer first. There are no circles."""
    arrows = imports()

    @cache
    def chain(path: Path) -> tuple[Path, ...]:
        return (path, *max((chain(target) for target in sorted(arrows[path])), key=len, default=()))

    return list(max(map(chain, sorted(arrows)), key=len))


def fullest_folder() -> tuple[int, str]:
    """Entries of the source folder that has most, and its name."""
    counts = []
    for folder in {path.parent for path in files(*SOURCE, suffixes=(*CODE, ".yaml", ".json"))}:
        entries = [entry for entry in folder.iterdir() if entry.name not in UNCOUNTED]
        counts.append((len(entries), str(folder.relative_to(ROOT))))
    return max(counts)


def rooms() -> int:
    """Rooms of `pipeline/`: folders and files at its top."""
    return sum(entry.name not in UNCOUNTED for entry in (ROOT / "pipeline").iterdir())


def cli_parameters() -> dict[str, int]:
    """Command -> arguments and options, without `--help`."""
    from typer.main import get_command

    from motionloom.pipeline.cli.main import app

    out: dict[str, int] = {}

    def count(name: str, command: Any) -> None:
        if not hasattr(command, "list_commands"):
            out[name] = sum(parameter.name != "help" for parameter in command.params)
            return
        context = command.context_class(command)
        for key in command.list_commands(context):
            count(f"{name} {key}".strip(), command.get_command(context, key))

    count("", get_command(app))
    return out


def anys() -> int:
    """How often the sources say `Any`, lines that import it apart."""
    text = "\n".join(path.read_text(encoding="utf-8") for path in files(*SOURCE))
    return sum(len(re.findall(r"\bAny\b", line)) for line in text.splitlines() if "import " not in line)


def small_files() -> list[Path]:
    """Source files under 70 lines that one other file imports: each could be a part of it.

    A baseline's folder has fixed names of files, so that a reader knows where its losses are: none counts.
    """
    importers: dict[Path, int] = {}
    for targets in imports().values():
        for target in targets:
            importers[target] = importers.get(target, 0) + 1
    return [
        path
        for path, count in sorted(importers.items())
        if count == 1 and path.name != "__init__.py" and "baselines" not in path.parts and lines([path]) < 70
    ]


def files_of_prose() -> list[Path]:
    """Test files that compare three sentences (of five words or more), in `assert` or `match=`."""
    out = []
    for path in tracked("tests/test_*.py", "tests/*/test_*.py"):
        compared = 0
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Assert):
                place: ast.AST = node.test
            elif isinstance(node, ast.keyword) and node.arg == "match":
                place = node.value
            else:
                continue
            texts = [one.value for one in ast.walk(place) if isinstance(one, ast.Constant)]
            compared += sum(isinstance(text, str) and len(text.split()) >= 5 for text in texts)
        if compared >= 3:
            out.append(path)
    return out


def figures() -> dict[str, int]:
    """Every figure by its name in the table of limits."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    words = sum(len(page.read_text(encoding="utf-8").split()) for page in tracked("*.md"))
    parameters = cli_parameters()
    return {
        "source lines": lines(source()),
        "test lines": lines(tracked("tests/*.py")),
        "benchmark lines": lines(tracked("benchmarks/*.py")),
        "words of Markdown": words,
        "commands": len(parameters),
        "command-line parameters": sum(parameters.values()),
        "rooms of `pipeline/`": rooms(),
        "entries of the fullest folder": fullest_folder()[0],
        "files on the longest chain of imports": len(longest_chain()),
        "files under 70 lines with one importer": len(small_files()),
        "test files that compare sentences": len(files_of_prose()),
        "the word `Any`, imports apart": anys(),
        "required packages": len(project["dependencies"]),
    } | {f"`{room}`": count for room, count in lines_of_rooms().items()}


def limits() -> dict[str, int]:
    """The most that each figure may be, from docs/architecture.md."""
    text = PAGE.read_text(encoding="utf-8").split(MARKERS[0])[1].split(MARKERS[1])[0]
    return {name: int(most) for name, most in re.findall(r"^\| (.+?) \| (\d+) \|$", text, re.M)}


def lower() -> None:
    """Write today's figures as the limits; one that would rise stays, unless it is new."""
    before = limits()
    rows = [f"| {name} | {min(value, before.get(name, value))} |" for name, value in figures().items()]
    start, rest = PAGE.read_text(encoding="utf-8").split(MARKERS[0])
    table = "\n".join(["| figure | most |", "|---|---|", *rows])
    end = rest.split(MARKERS[1])[1]
    PAGE.write_text(f"{start}{MARKERS[0]}\n{table}\n{MARKERS[1]}{end}", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument(
        "--lower", action="store_true", help="today's figures become the limits where they are less"
    )
    parser.add_argument("--chain", action="store_true", help="the files on the longest chain of imports")
    parser.add_argument("--small", action="store_true", help="files under 70 lines with one importer")
    parser.add_argument("--prose", action="store_true", help="test files that compare sentences")
    options = parser.parse_args()
    listed = (longest_chain() if options.chain else []) + (small_files() if options.small else [])
    listed += files_of_prose() if options.prose else []
    print("".join(f"{path.relative_to(ROOT)}\n" for path in listed), end="")
    if options.lower:
        lower()
    most = limits()
    for name, value in figures().items():
        print(f"{value:>7} of {most.get(name, 0):>7}  {name}")


if __name__ == "__main__":
    sys.exit(main())
