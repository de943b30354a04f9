"""The import arrows between folders and files, and the packaging list."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Mapping, Set
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from house_script import FENCE, house

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("configs", "datasets", "models", "pipeline")
RECORDS = tuple(f"motionloom.datasets.base.{name}" for name in ("errors", "json_doors", "config", "records"))
BOTTOM = ("motionloom.datasets.motion", *RECORDS, "motionloom.datasets.conditions")
BELOW = tuple(f"motionloom.datasets.base.{name}" for name in ("files", "randomness", "os_errors"))
"""What the bottom layer itself may use: files of the standard library and numpy alone."""
BOTTOM_LIBRARIES = {"numpy", "torch", "roma", "scipy", "pydantic", "pydantic_core", "motionloom"}


MODULE = re.compile(r"motionloom(\.\w+)+(:\w+)?")


@cache
def imports(path: Path) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; write motionloom.…"
            base = node.module or ""
            names.update(f"{base}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            # A module named in a text is imported by it; a group of entry points is none.
            named = node.value.partition(":")[0]
            there = MODULE.fullmatch(node.value) and (
                file_of(named).exists() or file_of(named).with_suffix("").is_dir()
            )
            names |= {named} if there else set()
    return names


def files(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


def file_of(module: str) -> Path:
    return ROOT / (module.removeprefix("motionloom.").replace(".", "/") + ".py")


def is_bottom(name: str) -> bool:
    return name.startswith(BOTTOM)


@pytest.mark.parametrize("path", files("models"), ids=str)
def test_models_import_only_the_bottom_layer(path: Path) -> None:
    for name in imports(path):
        if name.startswith("motionloom."):
            assert name.startswith("motionloom.models") or is_bottom(name), f"{path} imports {name}"


@pytest.mark.parametrize("path", files("datasets"), ids=str)
def test_datasets_import_neither_models_nor_pipeline(path: Path) -> None:
    for name in imports(path):
        assert not name.startswith(("motionloom.models", "motionloom.pipeline")), f"{path} imports {name}"


@pytest.mark.parametrize("path", [*files("datasets/motion"), *map(file_of, RECORDS)], ids=str)
def test_bottom_layer_is_small(path: Path) -> None:
    for name in imports(path):
        top = name.split(".")[0]
        assert top in BOTTOM_LIBRARIES or top in sys.stdlib_module_names, f"{path} imports {name}"
        assert not name.startswith("motionloom.") or is_bottom(name) or name.startswith(BELOW), (
            f"{path} imports {name}"
        )


@pytest.mark.parametrize("name", BELOW)
def test_what_lies_below_needs_nothing_of_ours(name: str) -> None:
    path = file_of(name)
    for used in imports(path):
        top = used.split(".")[0]
        own = used.startswith(BELOW)
        assert own or top == "numpy" or top in sys.stdlib_module_names, f"{path} imports {used}"


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(("motionloom", *(parts[:-1] if parts[-1] == "__init__" else parts)))


@cache
def file_arrows() -> dict[str, set[str]]:
    """Module -> modules of ours that it imports, inside functions too."""
    modules = {module_of(path): path for folder in FOLDERS for path in files(folder)}
    arrows = {}
    for module, path in modules.items():
        names = imports(path)
        # `from package.module import name` is listed as package.module.name.
        arrows[module] = {
            name if name in modules else name.rpartition(".")[0] for name in names
        } & modules.keys() - {module}
    return arrows


def room_of(module: str) -> str:
    """The folder a module lies in."""
    path = Path(*module.split(".")[1:])
    return (path if (ROOT / path).is_dir() else path.parent).as_posix()


def room_arrows() -> dict[str, set[str]]:
    """Room -> other rooms that a file of it imports from."""
    arrows: dict[str, set[str]] = {}
    for module, targets in file_arrows().items():
        room = room_of(module)
        arrows.setdefault(room, set()).update({room_of(target) for target in targets} - {room})
    return arrows


def circle(arrows: Mapping[str, Set[str]]) -> list[str]:
    """A circle of arrows; empty when there is none."""
    try:
        TopologicalSorter(arrows).prepare()
    except CycleError as error:
        found: list[str] = error.args[1]
        return found
    return []


def test_circles_are_found() -> None:
    assert circle({"a": {"b"}, "b": {"c"}, "c": set()}) == []
    assert set(circle({"a": {"b"}, "b": {"c"}, "c": {"b"}})) == {"b", "c"}
    assert "motionloom.datasets.base.records" in file_arrows()["motionloom.datasets.motion.layout"]
    assert "datasets/motion" in room_arrows()["models/tokenizer"]


def test_no_file_imports_itself_by_way_of_others() -> None:
    assert circle(file_arrows()) == []


def test_no_room_imports_itself_by_way_of_others() -> None:
    assert circle(room_arrows()) == []


FLOORS = {
    "pipeline": "curation editing rigs songs serve runs/cluster "
    "cli runs baselines stages results evaluation training inference contract store render launch",
    "models": "utt diffusion gpt tokenizer pretrained tma evaluator quantize discriminator "
    "condition metrics training layers",
    "datasets": "check convert synth actions loading shards modalities text motion audio base",
}
"""The rooms of each folder, from the top floor to the ground: a room imports from those after it."""


def test_arrows_go_down_the_floors() -> None:
    place = {f"{folder}/{room}": n for folder, text in FLOORS.items() for n, room in enumerate(text.split())}
    for room, targets in room_arrows().items():
        if room not in FOLDERS:  # what lies at a folder's top: the API, conditions.py
            assert top_of(room) in place, f"{room} is not in FLOORS"
            for target in {top_of(t) for t in targets if t not in FOLDERS} - {top_of(room)}:
                same = target.split("/")[0] == room.split("/")[0]
                assert not same or place[top_of(room)] < place[target], f"{room} stands below {target}"
    assert set(place) == {top_of(room) for room in room_arrows() if room not in FOLDERS}


@pytest.mark.parametrize("folder", FENCE)
def test_nothing_imports_what_stands_behind_the_fence(folder: str) -> None:
    behind = f"motionloom.{folder.replace('/', '.')}"
    # Each baseline is a folder of its own. A part of the server is imported by the server alone.
    depth = 4 if folder == "pipeline/baselines" else len(behind.split("."))
    for path in [p for top in FOLDERS for p in files(top)]:
        mine = module_of(path).split(".")[:depth]
        for name in imports(path):
            same = name.split(".")[:depth] == mine or mine[-1] == "table"
            same = same or (path.name == "served.py" and folder == "pipeline/serve")
            assert not name.startswith(behind) or same, f"{path} imports {name}"


def top_of(room: str) -> str:
    """`datasets/convert` of `datasets/convert/bvh`."""
    return room if room == "pipeline/runs/cluster" else "/".join(room.split("/")[:2])


READERS = {
    "synth": "pipeline/cli/data pipeline/stages/data pipeline/evaluation pipeline/songs "
    "datasets/convert/aistpp",
    "actions": "datasets/synth pipeline/stages/data pipeline/evaluation pipeline/inference/checks "
    "pipeline/baselines/tm2t/caption_figures pipeline/curation/requests",
}
"""Who may import the synthetic source, and the rules on joints that know its actions."""


@pytest.mark.parametrize("room", READERS)
def test_the_synthetic_source_stays_apart(room: str) -> None:
    """Streams, the server, captions of clips and checks of data sets know nothing of its actions."""
    own = f"motionloom.datasets.{room}"
    for module, targets in file_arrows().items():
        if not module.startswith(own) and any(target.startswith(f"{own}.") for target in targets):
            assert (
                module.removeprefix("motionloom.").replace(".", "/").startswith(tuple(READERS[room].split()))
            )


@pytest.mark.parametrize("folder", FOLDERS)
def test_first_party_imports_name_the_package(folder: str) -> None:
    """`import datasets` would find Hugging Face's package or ours, depending on the working directory."""
    for path in files(folder):
        for name in imports(path):
            assert name.split(".")[0] not in FOLDERS, f"{path} imports {name}; write motionloom.{name}"


def test_the_house_stays_small() -> None:
    """Every figure is within its limit in docs/architecture.md."""
    most, figures = house.limits(), house.figures()
    over = {name: (value, most.get(name)) for name, value in figures.items() if value > most.get(name, 0)}
    assert not over, "what came pays with what it replaces"
    assert figures.keys() == most.keys()
