"""The size and shape of the code in figures: lines, rooms, the longest chain of imports, options, `Any`.

    python benchmarks/house.py                      # this checkout
    python benchmarks/house.py --write              # and into docs/architecture.md

A room is what stands at the top of `pipeline/`. A chain is a file, a file that it imports, and so on;
imports inside functions count. `docs/architecture.md` holds this table between two markers; a test compares.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ("datasets", "models", "pipeline", "configs")
CODE = (".py", ".js", ".css", ".html")
UNCOUNTED = ("__pycache__", "__init__.py", "py.typed")
MARKERS = ("<!-- house -->", "<!-- /house -->")


def files(*folders: str, suffixes: tuple[str, ...] = (".py",)) -> list[Path]:
    """Files of these folders with one of the suffixes, sorted."""
    found = (path for folder in folders for path in (ROOT / folder).rglob("*"))
    return sorted(path for path in found if path.suffix in suffixes and "__pycache__" not in path.parts)


def lines(paths: list[Path]) -> int:
    """Lines of text of all files together."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def documents() -> list[Path]:
    """Every page for readers: those at the top and in `docs/`."""
    return sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


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


def table() -> str:
    """All figures as Markdown."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    entries, folder = fullest_folder()
    parameters = cli_parameters()
    rows: dict[str, object] = {
        "source lines (Python, JavaScript, CSS, HTML)": lines(files(*SOURCE, suffixes=CODE)),
        "test lines": lines(files("tests")),
        "words in documents": sum(len(page.read_text(encoding="utf-8").split()) for page in documents()),
        "rooms of `pipeline/`": rooms(),
        "entries of the fullest folder": f"{entries} (`{folder}/`)",
        "files on the longest chain of imports": len(longest_chain()),
        "commands; their parameters": f"{len(parameters)}; {sum(parameters.values())}",
        "the word `Any`, imports apart": anys(),
        "required packages": len(project["dependencies"]),
    }
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items())])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--write", action="store_true", help="also into docs/architecture.md")
    parser.add_argument("--chain", action="store_true", help="the files on the longest chain of imports")
    options = parser.parse_args()
    if options.chain:
        print("\n".join(str(path.relative_to(ROOT)) for path in longest_chain()))
    print(table())
    if options.write:
        page = ROOT / "docs" / "architecture.md"
        before, rest = page.read_text(encoding="utf-8").split(MARKERS[0])
        after = rest.split(MARKERS[1])[1]
        page.write_text(f"{before}{MARKERS[0]}\n{table()}\n{MARKERS[1]}{after}", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
