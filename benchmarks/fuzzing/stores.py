"""Readers of data sets and of what models, runs and caches leave in files."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import shard_samples
import torch
import yaml

from fuzzing.mutations import damaged_json, damaged_yaml
from fuzzing.sealed import damaged_checkpoint, damaged_npy, damaged_safetensors, damaged_tar, damaged_zip
from fuzzing.table import ROOT, Read, Seed, of_files, of_tree, reader
from motionloom.datasets.audio.beat_net import WEIGHTS, read_beat_net
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Decisions
from motionloom.datasets.check.dataset import examine
from motionloom.datasets.convert.common.removed import Removed
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.modalities.modality import FrameStats
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.finish import join_parts
from motionloom.datasets.shards.index import ShardIndex
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.tar import scan_tar
from motionloom.datasets.text.build import build_with_encoder
from motionloom.datasets.text.cache import TextCache
from motionloom.pipeline.editing.task import EditTask
from motionloom.pipeline.contract.lookup import finished_stages, open_exported
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.curation.search import _stored
from motionloom.pipeline.evaluation.figures import FigureFile
from motionloom.pipeline.inference.script import Script
from motionloom.pipeline.runs.continuation import Started
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.store.artifact import Compared
from motionloom.pipeline.store.data import Mix, Reference
from motionloom.pipeline.store.known_captions import load_known
from motionloom.pipeline.store.published_evaluator import _vocabulary
from motionloom.pipeline.store.run_state import run_state
from motionloom.pipeline.store.tokens import TokenStore
from motionloom.pipeline.store.training_log import read_flight, read_training_log
from motionloom.pipeline.store.weights import load_weights
from motionloom.pipeline.store.yaml import read_yaml
from motionloom.pipeline.training.checkpointing import readable, write_checkpoint

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


@reader(
    "shard",
    "datasets/shards/tar.py",
    "datasets/shards/index.py",
    "datasets/shards/sample.py",
    "datasets/check",
)
def _shard(folder: Path) -> Made:
    root = _shards(folder)
    before = (root / "manifest.json").read_bytes()

    def read(file: str) -> object:
        clips = scan_tar(root / file)
        manifest, content = json.loads(before), (root / file).read_bytes()
        stated = next(shard for shard in manifest["shards"] if shard["name"] == file)
        stated |= {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        (root / "manifest.json").write_bytes(_json(manifest))  # as whoever changes a file would do it
        if found := examine(root).errors:
            raise UserError(str(found[0]))
        return clips

    return of_tree(root, {".tar": damaged_tar}, read)


@reader("data set", "datasets/shards", "datasets/convert/common/removed.py")
def _data_set(folder: Path) -> Made:
    root = _shards(folder)
    (root / "cleaned.json").write_bytes(_json({"left_out": {"clip-a": "floats"}, "kept": ["clip-b"]}))
    (root / "removed.json").write_bytes(_json({"salt": "0f" * 16, "hashes": ["a" * 64]}))

    def read(file: str) -> object:
        if file == "cleaned.json":
            return Decisions.of(root)
        if file == "removed.json":
            return Removed.of(root).has("a", "b")
        if file.endswith(".index.json"):
            return ShardIndex.load_json(root / file)
        return _opened(root)

    damages = {
        "manifest.json": damaged_json,
        ".index.json": damaged_json,
        "index.npz": damaged_zip,
        "cleaned.json": damaged_json,
        "removed.json": damaged_json,
    }
    return of_tree(root, damages, read)


@reader("part of a conversion")
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
        index = json.loads((root / shard["name"].replace(".tar", ".index.json")).read_text())
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


@reader("search vectors", "pipeline/evaluation/search.py")
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


# Models.


@reader("weights", "pipeline/store/weights.py", "pipeline/baselines", "pipeline/store/published_evaluator.py")
def _weights(folder: Path) -> Made:
    from safetensors.torch import save

    def net() -> torch.nn.Module:
        return torch.nn.Sequential(torch.nn.Linear(6, 8), torch.nn.LayerNorm(8))

    return of_files(
        folder,
        "model.safetensors",
        [save(dict(net().state_dict()))],
        damaged_safetensors,
        lambda path: load_weights(path.parent, net()),
    )


@reader("statistics", "datasets/modalities", "datasets/loading/statistics.py")
def _statistics(folder: Path) -> Made:
    stats = FeatureStats.unit(MotionLayout.named("body133"))
    stats.save(folder / "stats.safetensors")
    FrameStats(np.zeros(5, np.float32), np.ones(5, np.float32), 4, 30.0).save(folder / "audio.safetensors")
    seeds = [
        Seed(name, (folder / name).read_bytes(), damaged_safetensors)
        for name in ("stats.safetensors", "audio.safetensors")
    ]
    np.save(folder / "Mean.npy", np.zeros(263, np.float32))
    np.save(folder / "Std.npy", np.ones(263, np.float32))
    seeds += [Seed(name, (folder / name).read_bytes(), damaged_npy) for name in ("Mean.npy", "Std.npy")]

    def read(seed: Seed, content: bytes) -> object:
        path = folder / seed.file
        path.write_bytes(content)
        try:
            if seed.file.endswith("npy"):
                return FeatureStats.of_arrays(
                    folder / "Mean.npy", folder / "Std.npy", MotionLayout.named("h3d263")
                )
            return (FeatureStats if "stats" in seed.file else FrameStats).load(path)
        finally:
            path.write_bytes(seed.content)

    return seeds, read


@reader("tokens", "pipeline/store/tokens.py")
def _tokens(folder: Path) -> Made:
    store = TokenStore({"body": torch.arange(12)}, np.array([0, 2, 6]), {"body": 2}, np.array([True, False]))
    store.save(folder / "tokens.safetensors")
    content = (folder / "tokens.safetensors").read_bytes()
    return of_files(
        folder,
        "tokens.safetensors",
        [content],
        damaged_safetensors,
        lambda path: TokenStore.load(path, {"body": 2}),
    )


@reader("known captions", "pipeline/store/known_captions.py")
def _known(folder: Path) -> Made:
    from safetensors.numpy import save

    tree = folder / "known"
    tree.mkdir()
    own = {"captions": ["a person walks", "waves"], "distances": [0.1, 0.2]}
    (tree / "known.json").write_bytes(
        _json({"body": own, "face": {"captions": [], "distances": []}, "actions": ["walk"]})
    )
    vectors = {"body": np.ones((2, 4), np.float16), "face": np.zeros((0, 4), np.float16)}
    (tree / "known.safetensors").write_bytes(save(vectors))
    return of_tree(
        tree, {".json": damaged_json, ".safetensors": damaged_safetensors}, lambda _: load_known(tree)
    )


@reader("beat network", "datasets/audio/beat_net.py")
def _beats(folder: Path) -> Made:
    return of_files(folder, "a.safetensors", [WEIGHTS.read_bytes()], damaged_safetensors, read_beat_net)


@reader("published vocabulary")
def _published(folder: Path) -> Made:
    whole = {
        "words": ["sos", "eos", "unk", "walk"],
        "classes": ["OTHER", "VERB"],
        "lists": {"VERB": ["walk"]},
    }
    seeds, read = of_files(folder, "a.json", [_json(whole)], damaged_json, _vocabulary)
    return seeds, read


@reader("export", "pipeline/contract/lookup.py", "pipeline/store", "pipeline/stages/networks")
def _export(folder: Path) -> Made:
    tree = folder / "inbetween"
    shutil.copytree(ROOT / "models/pretrained/inbetween", tree)

    def read(file: str) -> object:
        if not file.endswith("artifact.json") and "/" in file:  # as whoever changes a file would do it
            record = tree / file.split("/")[0] / "artifact.json"
            facts: dict[str, Any] = json.loads(record.read_bytes())
            content = (tree / file).read_bytes()
            facts["outputs"][file.split("/")[1]] = {
                "bytes": len(content),
                "sha256": hashlib.sha256(content).hexdigest(),
            }
            before = record.read_bytes()
            record.write_bytes(_json(facts))
            try:
                return [StageCache().get(stage) for stage in open_exported(tree)]
            finally:
                record.write_bytes(before)
        return open_exported(tree)

    damages = {
        "bundle.json": damaged_json,
        "artifact.json": damaged_json,
        "model.json": damaged_json,
        "text.json": damaged_json,
        "stats.safetensors": damaged_safetensors,
    }
    return of_tree(tree, damages, read)


@reader("checkpoint", "pipeline/training/checkpointing.py", "models/training")
def _checkpoint(folder: Path) -> Made:
    path = folder / "step=00000020.ckpt"
    write_checkpoint(
        {
            "global_step": 20,
            "state_dict": {"a.weight": torch.ones(3, 2)},
            "hyper": {"kind": "gpt", "x": [1.5]},
        },
        path,
    )

    def read(path: Path) -> object:
        said: list[str] = []
        found = list(readable(path.parent, said.append))
        if not found:
            raise UserError(said[0])
        return found

    return of_files(folder, path.name, [path.read_bytes()], damaged_checkpoint, read)


@reader("text cache", "datasets/text")
def _text_cache(folder: Path) -> Made:
    from text_samples import WordLengths

    captions = ["a person walks", "waves", "someone turns around twice"]
    tree = folder / "cache"
    build_with_encoder(tree, captions, WordLengths(), progress=False)

    def read(_: str) -> object:
        cache = TextCache.open(tree)
        cache.captions_by_key()
        cache.similarity(captions)
        return cache.tokens(captions)

    damages = {".npy": damaged_npy, "cache.json": damaged_json, "captions.jsonl": damaged_json}
    return of_tree(tree, damages, read)


# Runs, recipes, scripts.


@reader("recipe", "pipeline/runs", "pipeline/store/yaml.py", "pipeline/stages")
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


@reader("edit task")
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


@reader("script", "pipeline/inference/script.py")
def _script(folder: Path) -> Made:
    from fuzzing.files import sound

    sound(folder, "wav")
    script = {
        "segments": [{"text": "a person walks", "seconds": 3}, {"music": "a.wav@0:00-0:01", "text": "dances"}]
    }
    return of_files(folder, "script.yaml", [yaml.safe_dump(script).encode()], damaged_yaml, Script.read)


@reader("figures", "pipeline/evaluation/figures.py")
def _figures(folder: Path) -> Made:
    from run_records import reconstruction

    reconstruction(12.5).write(folder / "figures.json")
    return of_files(
        folder, "figures.json", [(folder / "figures.json").read_bytes()], damaged_json, FigureFile.read
    )


@reader("training log", "pipeline/store/training_log.py", "pipeline/training")
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


@reader("run folder", "pipeline/runs/continuation.py")
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
