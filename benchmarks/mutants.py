"""How many small faults in the core the tests find: mutants drawn at random, one at a time, in a copy.

    python benchmarks/mutants.py WORK --count 50 --seed 1

A mutant changes one place of one file of the core: a comparison, an operator, a number, a condition, `min` or
`max`. Places are drawn by the seed. For each, the tests run that import its module or lie in the folder that
mirrors its own, first the fast ones, then the slow ones, until one fails. What no test finds is printed with
its line, for a person to say whether it changes anything. WORK keeps the copy and the rows, so that a killed
run goes on.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))
import house  # noqa: E402

SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
MINUTES = 4
"""Most that the tests of one mutant may take; one that makes them endless is found."""


@dataclass(frozen=True)
class Place:
    """A place of a file that can be changed: the number of the node in the order of `ast.walk`."""

    path: Path
    node: int
    line: int


def changed(node: ast.AST) -> bool:
    """Change a node in place; whether there is anything to change."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
        node.ops[0] = SWAPS[type(node.ops[0])]()  # type: ignore[assignment]
    elif isinstance(node, ast.BinOp | ast.BoolOp) and type(node.op) in SWAPS:
        node.op = SWAPS[type(node.op)]()  # type: ignore[assignment]
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        node.value = node.value + 1
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        node.value = not node.value
    elif isinstance(node, ast.If | ast.IfExp):
        node.test = ast.UnaryOp(ast.Not(), node.test)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("min", "max"):
        node.func.id = "max" if node.func.id == "min" else "min"
    else:
        return False
    return True


def places() -> list[Place]:
    """All places of the core's files: within functions, where names of types and texts of help are not."""
    out = []
    for path in house.source(fence=False):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        inside = {
            id(node)
            for function in ast.walk(tree)
            if isinstance(function, ast.FunctionDef)
            for statement in function.body
            for node in ast.walk(statement)
        }
        for number, node in enumerate(ast.walk(tree)):
            if id(node) in inside and hasattr(node, "lineno") and changed(node):
                out.append(Place(path.relative_to(ROOT), number, node.lineno))
    return out


def mutant(place: Place) -> str:
    """The source of a file with one place changed."""
    tree = ast.parse((ROOT / place.path).read_text(encoding="utf-8"))
    changed(list(ast.walk(tree))[place.node])
    return ast.unparse(ast.fix_missing_locations(tree))


def tests_of(path: Path) -> list[str]:
    """Test files that import a module, and those of the folder that mirrors its own."""
    module = "motionloom." + ".".join(path.with_suffix("").parts)
    listed = sorted((ROOT / "tests").rglob("test_*.py"))
    named = [test for test in listed if module in test.read_text(encoding="utf-8")]
    mirror = ROOT / "tests" / path.parent
    while not mirror.is_dir():
        mirror = mirror.parent
    mirrored = [test for test in listed if test.is_relative_to(mirror) and test not in named]
    return [str(test.relative_to(ROOT)) for test in (*named, *mirrored)]


def found(copy: Path, tests: list[str]) -> str:
    """Which test finds the fault that is in the copy; empty where none does."""
    given = {**os.environ, "PYTHONPATH": str(copy.parent), "OMP_NUM_THREADS": "1"}
    for marks in ("not slow and not browser and not slurm", "slow and not browser and not slurm"):
        words = [
            sys.executable,
            "-P",
            "-m",
            "pytest",
            "-x",
            "-q",
            "-p",
            "no:cacheprovider",
            "-m",
            marks,
            *tests,
        ]
        try:
            done = subprocess.run(
                words, cwd=copy, env=given, capture_output=True, text=True, timeout=60 * MINUTES, check=False
            )
        except subprocess.TimeoutExpired:
            return "endless"
        if done.returncode == 1 or done.returncode == 2:
            named = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
            return named[0].split(" - ")[0] if named else "collection"
    return ""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("work", type=Path, help="a folder for the copy and the rows")
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rows = options.work / f"mutants-{options.seed}.jsonl"
    copy = options.work / "motionloom"
    options.work.mkdir(parents=True, exist_ok=True)
    if not copy.exists():
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", ".venv", "build", "runs"))
    drawn = random.Random(options.seed).sample(places(), options.count)
    known = [json.loads(line) for line in rows.read_text().splitlines()] if rows.is_file() else []
    for place in drawn[len(known) :]:
        tests = tests_of(place.path)
        (copy / place.path).write_text(mutant(place), encoding="utf-8")
        by = found(copy, tests) if tests else ""
        shutil.copy2(ROOT / place.path, copy / place.path)
        known.append({"place": f"{place.path}:{place.line}", "found": by, "tests": len(tests)})
        with rows.open("a") as file:
            file.write(json.dumps(known[-1]) + "\n")
        print(f"{known[-1]['place']}: {by or 'NOT FOUND'}", flush=True)
    missed = [row["place"] for row in known if not row["found"]]
    print(f"{len(known) - len(missed)} of {len(known)} found; not: {', '.join(missed) or 'none'}")


if __name__ == "__main__":
    main()
