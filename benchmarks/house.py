"""The size and shape of the code in figures, each with the most that it may be.

    python benchmarks/house.py                  # this checkout, figure by figure
    python benchmarks/house.py --rooms          # tokens by folder
    python benchmarks/house.py --chain --tuples --inside          # the files behind a figure

Tokens are those of Python's `tokenize`, without comments, docstrings and line ends, so that nothing is won
by two statements on a line. What neither paper needs stands behind the fence (`FENCE`), which nothing
imports. The limits stand in `docs/architecture.md` between two markers; a test holds them. A repair is always
paid for; when a total is within 2 % of its limit, the next feature pays with what it replaces.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import sys
import tokenize
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "architecture.md"
SOURCE = ("datasets", "models", "pipeline", "configs")
CODE = (".py", ".js", ".css", ".html")
UNCOUNTED = ("__pycache__", "__init__.py", "__init__.pyi", "py.typed")
MARKERS = ("<!-- house -->", "<!-- /house -->")
FENCE = (
    "pipeline/baselines",
    "pipeline/curation",
    "pipeline/editing",
    "pipeline/rigs",
    "pipeline/serve",
    "pipeline/runs/cluster",
    "pipeline/songs",
    "datasets/convert/sets",
)
"""Folders of what neither paper needs; each registers as a stranger's package would, and may be removed."""
_NO_TOKENS = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}


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


def source(*, fence: bool) -> list[Path]:
    """Python files of the core, or of what stands behind the fence."""
    behind = tuple(ROOT / folder for folder in FENCE)
    return [path for path in files(*SOURCE) if any(path.is_relative_to(one) for one in behind) == fence]


@cache
def tree(path: Path) -> ast.Module:
    """The syntax of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


def docstring_lines(path: Path) -> set[int]:
    """Lines of a file's docstrings: of texts that are a statement of their own."""
    found: set[int] = set()
    for node in ast.walk(tree(path)):
        value = node.value if isinstance(node, ast.Expr) else None
        if isinstance(value, ast.Constant) and isinstance(value.value, str):
            found.update(range(value.lineno, (value.end_lineno or value.lineno) + 1))
    return found


def tokens(path: Path) -> int:
    """Tokens of a file, without comments, docstrings and line ends."""
    text = path.read_text(encoding="utf-8")
    described = docstring_lines(path)
    return sum(
        token.type not in _NO_TOKENS and not (token.type == tokenize.STRING and token.start[0] in described)
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
    )


def tokens_by_room() -> dict[str, int]:
    """Folder such as `pipeline/runs` -> tokens of its files."""
    out: dict[str, int] = {}
    for path in files(*SOURCE):
        room = "/".join(path.relative_to(ROOT).parts[:2])
        out[room] = out.get(room, 0) + tokens(path)
    return dict(sorted(out.items()))


def tuple_assignments(path: Path) -> Iterator[int]:
    """Lines with `a, b = x, y`, which are two statements; for values that belong together."""
    for node in ast.walk(tree(path)):
        is_tuple = isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple)
        if is_tuple and any(isinstance(target, ast.Tuple) for target in node.targets):
            yield node.lineno


def imports_inside(path: Path) -> int:
    """Imports within functions."""
    inside = [
        node for node in ast.walk(tree(path)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    found = {one for node in inside for one in ast.walk(node) if isinstance(one, ast.Import | ast.ImportFrom)}
    return len(found)


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


def figures() -> dict[str, float]:
    """Every figure by its name in the table of limits."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    code = files(*SOURCE)
    parameters = cli_parameters()
    arrows = imports()
    tuples = sum(1 for path in code for _ in tuple_assignments(path))
    return {
        "tokens of the core": sum(map(tokens, source(fence=False))),
        "tokens behind the fence": sum(map(tokens, source(fence=True))),
        "lines of tests": lines(tracked("tests/*.py")),
        "lines of the longest file": max(lines([path]) for path in files(*SOURCE, "tests", "benchmarks")),
        "entries of the fullest folder": fullest_folder()[0],
        "files on the longest chain of imports": len(longest_chain()),
        "imports of a file, mean": round(sum(map(len, arrows.values())) / len(arrows), 1),
        "imports within functions": sum(map(imports_inside, code)),
        "tuple assignments in 1,000 lines": round(1000 * tuples / lines(code), 1),
        "commands": len(parameters),
        "command-line parameters": sum(parameters.values()),
        "required packages": len(project["dependencies"]),
    }


def limits() -> dict[str, float]:
    """The most that each figure may be, from docs/architecture.md."""
    text = PAGE.read_text(encoding="utf-8").split(MARKERS[0])[1].split(MARKERS[1])[0]
    rows = re.findall(r"^\| (.+?) \| ([\d,.]+) \|$", text, re.M)
    return {name: float(most.replace(",", "")) for name, most in rows}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rooms", action="store_true", help="tokens by folder")
    parser.add_argument("--chain", action="store_true", help="the files on the longest chain of imports")
    parser.add_argument("--tuples", action="store_true", help="the lines with a tuple assignment")
    parser.add_argument("--inside", action="store_true", help="the files with imports within functions")
    options = parser.parse_args()
    if options.rooms:
        for room, count in tokens_by_room().items():
            print(f"{count:>7}  {room}")
    if options.chain:
        print("\n".join(str(path.relative_to(ROOT)) for path in longest_chain()))
    for path in files(*SOURCE):
        for line in tuple_assignments(path) if options.tuples else ():
            print(f"{path.relative_to(ROOT)}:{line}")
        if options.inside and (count := imports_inside(path)):
            print(f"{count:>3}  {path.relative_to(ROOT)}")
    most = limits()
    for name, value in figures().items():
        print(f"{value:>9,} of {most.get(name, 0):>9,.15g}  {name}")


if __name__ == "__main__":
    sys.exit(main())
