"""Readers, and the table of all of them: files of motion, of data sets and of models, sources of
converters, requests to the server.

A reader stands here with genuine contents (seeds), a mutator for each, and the call that reads. `missing()`
names what the program reads and this table does not: the test of it keeps both together.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fuzzing.mutations import Mutator

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Seed:
    """A genuine content: the name of the file that it is, and how it is damaged."""

    file: str
    content: bytes
    damage: Mutator


Read = Callable[[Seed, bytes], object]
"""Reads a content in the place of a seed's; anything but a `UserError` is a fault."""
Make = Callable[[Path], tuple[list[Seed], Read]]
"""In an empty folder: the seeds, and the call that reads."""


@dataclass(frozen=True)
class Reader:
    """A reader of outside bytes."""

    name: str
    make: Make
    doors: tuple[str, ...] = ()
    """Ends of the paths of the modules that it covers, which may move."""


READERS: dict[str, Reader] = {}


def reader(name: str, *doors: str) -> Callable[[Make], Make]:
    """Add the function below as the reader `name`; `doors` end the paths of modules that it covers."""

    def add(make: Make) -> Make:
        assert name not in READERS, name
        READERS[name] = Reader(name, make, doors)
        return make

    return add


def of_files(
    folder: Path, file: str, contents: Sequence[bytes], damage: Mutator, read: Callable[[Path], object]
) -> tuple[list[Seed], Read]:
    """Seeds that are written to one file, and read from there."""

    def reading(seed: Seed, content: bytes) -> object:
        (folder / seed.file).write_bytes(content)
        return read(folder / seed.file)

    return [Seed(file, content, damage) for content in contents], reading


def of_tree(
    tree: Path, damages: dict[str, Mutator], read: Callable[[str], object]
) -> tuple[list[Seed], Read]:
    """Seeds that are the files of a folder, each damaged in its place; `damages` go by the files' endings."""
    seeds = [
        Seed(path.relative_to(tree).as_posix(), path.read_bytes(), damage)
        for path in sorted(tree.rglob("*"))
        for ending, damage in damages.items()
        if path.is_file() and path.name.endswith(ending)
    ]

    def reading(seed: Seed, content: bytes) -> object:
        place = tree / seed.file
        try:
            place.write_bytes(content)
            return read(seed.file)
        finally:
            place.write_bytes(seed.content)

    return seeds, reading


# What the program reads.

_DOORS = {
    "read_plain",
    "open_plain",
    "NpzFile",
    "npy_header",
    "map_npy",
    "load_array",
    "check_array_header",
    "read_npy_header",
    "parse_json",
    "load_json",
    "load_file",
    "safe_open",
    "read_yaml",
    "load_yaml",
    "read_text_file",
    "read_csv",
    "read_json",
    "read_json_lines",
    "read_ids",
    "read_record",
    "read_split_files",
    "SoundFile",
    "scan_tar",
    "torch.load",
    "json.load",
    "json.loads",
    "yaml.load",
    "csv.reader",
    "csv.DictReader",
    "pickle.load",
    "pickle.Unpickler",
    "zipfile.ZipFile",
    "tarfile.open",
    "np.load",
    "np.fromfile",
    "GLTF2",
}
"""Calls that take bytes from outside."""

NOT_OUTSIDE = {
    "datasets/base/files.py": "headers that it has written itself",
    "datasets/base/register.py": "code of installed packages, which is trusted",
    "datasets/motion/skeleton.py": "the package's own skeletons",
    "datasets/synth": "the package's own words and genres",
    "datasets/convert/bvh/tools.py": "the package's own list of tools",
    "datasets/convert/sets/shared": "settings",
    "pipeline/cli": "the options of a command, which are the user's",
    "pipeline/inference/shipped_models.py": "the package's own cards",
    "pipeline/results/paper": "the package's own tables",
    "pipeline/runs/launch_plan.py": "options",
    "pipeline/render/page.py": "script of a page",
    "pipeline/contract/units.py": "arrays of the process that reads them",
    "pipeline/render/body/mesh.py": "the package's own body",
    "pipeline/render/sound.py": "writes",
}


def doors() -> dict[str, list[str]]:
    """The modules of the package that take bytes from outside, and the calls by which they do."""
    found: dict[str, list[str]] = {}
    for path in sorted(p for top in ("datasets", "models", "pipeline") for p in (ROOT / top).rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call):
                call = ast.unparse(node.func)
                if call in _DOORS or call.rpartition(".")[2] in _DOORS - {"load", "loads"}:
                    found.setdefault(name, []).append(f"{call}:{node.lineno}")
    return {
        name: calls for name, calls in found.items() if not any(name.startswith(one) for one in NOT_OUTSIDE)
    }


def missing() -> list[str]:
    """Readers, converters and requests of the program that have no row, or a row without seed or mutator."""
    from fuzzing.requests import ROUTES, routes
    from fuzzing.trees import TREES
    from motionloom.datasets.convert.registry import names

    covered = {door for row in READERS.values() for door in row.doors}
    lacking = [
        f"no reader covers {name} ({', '.join(calls)})"
        for name, calls in doors().items()
        if not any(f"/{name}".endswith(f"/{one}") for one in covered)
    ]
    lacking += [f"no seeds for the converter {name}" for name in names() if name not in TREES]
    lacking += [f"no seeds for the request {route}" for route in routes() if route not in ROUTES]
    return lacking
