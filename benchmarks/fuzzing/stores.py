"""Readers of data sets and of what models, runs and caches leave in files."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import shard_samples
import yaml

from fuzzing.mutations import damaged_json, damaged_yaml
from fuzzing.sealed import damaged_tar, damaged_zip
from fuzzing.table import Read, Seed, of_files, of_tree, reader
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.memory import content_of, recall, remembering
from motionloom.datasets.base.records import Column, Decisions
from motionloom.datasets.check.dataset import examine
from motionloom.datasets.convert.common.removed import Removed
from motionloom.datasets.shards.finish import join_parts
from motionloom.datasets.shards.index import ShardIndex
from motionloom.datasets.shards.reader import ShardDataset, load_manifest
from motionloom.datasets.shards.tar import scan_tar
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.curation.add_command import add
from motionloom.pipeline.curation.search import _stored
from motionloom.pipeline.editing.task import EditTask
from motionloom.pipeline.evaluation.figures import FigureFile
from motionloom.pipeline.inference.script import Script
from motionloom.pipeline.runs.continuation import Started
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.store.artifact import Compared
from motionloom.pipeline.store.data import Mix, Reference
from motionloom.pipeline.store.run_state import run_state
from motionloom.pipeline.store.training_log import read_flight, read_training_log
from motionloom.pipeline.store.yaml import read_yaml

Made = tuple[list[Seed], Read]


def _json(value: object) -> bytes:
    return json.dumps(value).encode()


# Data sets.


def _shards(folder: Path) -> Path:
    shard_samples.write(folder / "set", count=10)
    return folder / "set"


def _opened(root: Path) -> object:
    for split in ("train", "val", "test"):
        dataset = ShardDataset.open(root, split)
        for clip in range(min(len(dataset), 2)):
            dataset.motion(clip)
            dataset.meta(clip)
            dataset.texts(clip)
    return root


@reader("shard", "shards/tar.py", "shards/index.py", "shards/sample.py", "check/dataset.py", "duplicates.py")
def _shard(folder: Path) -> Made:
    root = _shards(folder)
    before = (root / "manifest.json").read_bytes()

    def read(file: str) -> object:
        clips = scan_tar(root / file)
        manifest = json.loads(before)
        content = (root / file).read_bytes()
        stated = next(shard for shard in manifest["shards"] if shard["name"] == file)
        stated |= {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        (root / "manifest.json").write_bytes(_json(manifest))  # as whoever changes a file would do it
        if found := examine(root).errors:
            raise UserError(str(found[0]))
        return clips

    return of_tree(root, {".tar": damaged_tar}, read)


@reader("column", "shards/columns.py", "check/columns.py", "check/shard.py", "curation/add_command.py")
def _column(folder: Path) -> Made:
    root = _shards(folder)
    (folder / "more.jsonl").write_text('{"id": "clip-ä-1", "captions": ["more"]}')
    add(str(root), folder / "more.jsonl")

    def read(file: str) -> object:
        if file.endswith(".json"):
            return Column.load_json(root / file).fits(load_manifest(root).shards)
        if file.endswith(".tar"):
            scan_tar(root / file, column="more.json")
        if found := examine(root).errors:
            raise UserError(str(found[0]))
        return _opened(root)

    damages = {"column.json": damaged_json, "index.npz": damaged_zip, ".tar": damaged_tar}
    return of_tree(root / "columns", damages, lambda file: read(f"columns/{file}"))


@reader(
    "data set",
    "shards/reader.py",
    "shards/store.py",
    "shards/cache.py",
    "common/removed.py",
    "curation/clean_command.py",
)
def _data_set(folder: Path) -> Made:
    root = _shards(folder)
    (root / "cleaned.json").write_bytes(_json({"left_out": {"clip-a": "floats"}, "kept": ["clip-b"]}))
    (root / "removed.json").write_bytes(_json({"salt": "0f" * 16, "hashes": ["a" * 64]}))

    def read(file: str) -> object:
        if file == "cleaned.json":
            return Decisions.of(root)
        if file == "removed.json":
            return Removed.of(root).has("a", "b")
        if file.endswith(".index"):
            return ShardIndex.load_json(root / file)
        return _opened(root)

    damages = {
        "manifest.json": damaged_json,
        ".index": damaged_json,
        "index.npz": damaged_zip,
        "cleaned.json": damaged_json,
        "removed.json": damaged_json,
    }
    return of_tree(root, damages, read)


@reader("note of sources", "base/memory.py")
def _note(folder: Path) -> Made:
    source = folder / "walk.txt"
    source.write_text("a person walks")

    def read(note: Path) -> object:
        with remembering(note):
            return recall("text", source, source.read_text), content_of(source)

    read(folder / ".sources.json")
    content = (folder / ".sources.json").read_bytes()
    return of_files(folder, ".sources.json", [content], damaged_json, read)


@reader("part of a conversion", "shards/finish.py", "shards/tasks.py", "shards/writer.py")
def _parts(folder: Path) -> Made:
    root = _shards(folder)
    manifest = json.loads((root / "manifest.json").read_text())
    (root / "manifest.json").unlink()
    planned = {
        "manifest": {**manifest, "shards": []},
        "fingerprints": {},
        "items": 0,
        "lost": [],
        "most_lost": 0.5,
    }
    for shard in manifest["shards"]:
        index = json.loads((root / shard["name"].replace(".tar", ".index")).read_text())
        planned["fingerprints"][shard["name"]] = index["fingerprint"]
    content = _json(planned)

    def read(_: Seed, content: bytes) -> object:
        (root / ".parts").mkdir(exist_ok=True)  # which is removed where the parts are joined
        (root / ".parts/1-of-1.json").write_bytes(content)
        try:
            return join_parts(root)
        finally:
            (root / "manifest.json").unlink(missing_ok=True)

    return [Seed("1-of-1.json", content, damaged_json)], read


@reader("search vectors", "curation/search.py")
def _search(folder: Path) -> Made:
    np.savez(
        folder / "a.npz", made_from=np.frombuffer(b"x" * 64, np.uint8), vectors=np.ones((4, 8), np.float16)
    )
    return of_files(
        folder,
        "a.npz",
        [(folder / "a.npz").read_bytes()],
        damaged_zip,
        lambda path: _stored(path, "x" * 64, (4, 8)),
    )


# Runs, recipes, scripts.


@reader("recipe", "runs/resolve.py", "runs/layers.py", "store/yaml.py")
def _recipe(folder: Path) -> Made:
    small: dict[str, Any] = {
        "name": "small",
        "seed": 7,
        "hardware": {"accelerator": "cpu", "workers": 0},
        "defaults": {"trained": {"train": {"steps": 20, "batch_size": 8}}},
        "stages": {
            "data": {"kind": "synth", "clips": 20, "dances": {"songs": 3}, "hold_out": [{"action": "walk"}]},
            "stats": {"kind": "stats"},
            "text": {"kind": "text"},
            "tokenizer": {
                "kind": "rvq",
                "net": {"width": 32, "num_codes": 16},
                "optim": {"lr": 1e-3, "betas": [0.9, 0.99]},
            },
            "tokens": {"kind": "tokens"},
            "gpt": {"kind": "gpt", "net": {"dim": 32, "layers": 1}},
        },
    }
    child = {
        "extends": "humantomato-tiny",
        "name": "child",
        "stages": {"gpt": {"train": {"steps": 3}}, "tma": None},
    }
    contents = [yaml.safe_dump(one, sort_keys=False).encode() for one in (small, child)]
    return of_files(folder, "recipe.yaml", contents, damaged_yaml, load_recipe)


@reader("edit task", "editing/command.py")
def _task(folder: Path) -> Made:
    task = {
        "keep": [{"start": 0, "end": 1.5, "parts": ["lower"]}],
        "caption": "waves",
        "seconds": 4,
        "lead": 0.5,
        "path": [{"at": 0, "x": 0, "z": 1}],
        "pins": [{"at": 1, "joint": "left_wrist", "position": [0, 1, 0]}],
    }
    return of_files(
        folder,
        "task.yaml",
        [yaml.safe_dump(task).encode()],
        damaged_yaml,
        lambda path: EditTask.parse(read_yaml(path), str(path)),
    )


@reader("script", "inference/script.py")
def _script(folder: Path) -> Made:
    from fuzzing.files import sound

    sound(folder, "wav")
    script = {
        "segments": [{"text": "a person walks", "seconds": 3}, {"music": "a.wav@0:00-0:01", "text": "dances"}]
    }
    return of_files(folder, "script.yaml", [yaml.safe_dump(script).encode()], damaged_yaml, Script.read)


@reader("figures", "evaluation/figures.py")
def _figures(folder: Path) -> Made:
    from run_records import reconstruction

    reconstruction(12.5).write(folder / "figures.json")
    return of_files(
        folder, "figures.json", [(folder / "figures.json").read_bytes()], damaged_json, FigureFile.read
    )


@reader("training log", "training_log.py", "metric_log.py")
def _log(folder: Path) -> Made:
    tree = folder / "stage"
    (tree / "flight").mkdir(parents=True)
    rows = "\n".join(
        json.dumps({"step": step, "train/loss": 1 / (step + 1), "elapsed_seconds": step * 0.5})
        for step in range(5)
    )
    (tree / "metrics.jsonl").write_text(rows + "\n")
    (tree / "flight/rank_0.jsonl").write_text(rows + "\n")
    return of_tree(tree, {".jsonl": damaged_json}, lambda _: (read_training_log(tree), read_flight(tree)))


@reader(
    "run folder",
    "continuation.py",
    "runs/plan.py",
    "dry_run.py",
    "run_folder.py",
    "run_state.py",
    "store/data.py",
    "report_parts.py",
)
def _run(folder: Path) -> Made:
    from run_records import write_run

    run = write_run(folder / "run", {"data": {"kind": "synth", "clips": 20}, "stats": {"kind": "stats"}})
    (run / "stages/data").mkdir(parents=True, exist_ok=True)
    records = {
        "started.json": {
            "fingerprint": "0" * 64,
            "training": {"config": {"train.steps": 5}, "others": "x"},
            "changed": [],
        },
        "mix.json": {"parts": [{"stage": "data", "folder": None, "weight": 1.0}]},
        "reference.json": {"path": "shards", "order": "global", "shards_per_group": 8},
        "compared.json": {"files": {"a": {"sha256": "0" * 64, "states": [[1, 2, 3, 4]]}}},
    }
    for name, record in records.items():
        (run / name).write_bytes(_json(record))

    def read(file: str) -> object:
        match file:
            case "started.json":
                return Started.find(run)
            case "mix.json":
                return Mix.load_json(run / file)
            case "reference.json":
                return Reference.load_json(run / file)
            case "compared.json":
                return Compared.read(run / file)
        run_state(run)
        return finished_stages(run)

    return of_tree(run, {".json": damaged_json, "recipe.yaml": damaged_yaml}, read)
