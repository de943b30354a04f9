"""Readers of what models leave in files: weights, statistics, exports, checkpoints, caches of texts."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fuzzing.mutations import damaged_json
from fuzzing.sealed import damaged_checkpoint, damaged_npy, damaged_safetensors
from fuzzing.table import ROOT, Read, Seed, of_files, of_tree, reader
from motionloom.datasets.audio.beat_net import WEIGHTS, read_beat_net
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.modalities.modality import FrameStats
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.text.build import build_with_encoder
from motionloom.datasets.text.cache import TextCache
from motionloom.pipeline.contract.lookup import open_exported
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.diagnosis import FILE_NAME as DETAILS
from motionloom.pipeline.evaluation.diagnosis import showings
from motionloom.pipeline.store.known_captions import load_known
from motionloom.pipeline.store.published_evaluator import _vocabulary
from motionloom.pipeline.store.tokens import TokenStore
from motionloom.pipeline.store.weights import load_weights
from motionloom.pipeline.training.checkpointing import readable, write_checkpoint

Made = tuple[list[Seed], Read]


def _json(value: object) -> bytes:
    return json.dumps(value).encode()


# Models.


@reader("weights", "store/weights.py", "tm2t/generator.py")
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


@reader("statistics", "modality.py", "loading/statistics.py")
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


@reader("tokens", "store/tokens.py")
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


@reader("known captions", "known_captions.py")
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


@reader("diagnosis", "evaluation/diagnosis.py")
def _diagnosis(folder: Path) -> Made:
    from safetensors.numpy import save

    case = {"of": "generated", "place": "worst 1", "id": "a", "caption": "walks", "error": 0.5}
    facts = {
        "fps": 20.0,
        "skeleton": "smpl22",
        "joints": {"pelvis": 1.0, "head": 12.5},
        "actions": {"generated": {"walk": {"walk": 3, "run": 1}}},
        "cases": [case],
    }
    joints = np.zeros((5, 22, 3), np.float32)
    arrays = save({"0.recorded": joints, "0.generated": joints})
    (folder / DETAILS).write_bytes(arrays)
    seeds = [Seed(DETAILS, arrays, damaged_safetensors), Seed("metrics.json", _json(facts), damaged_json)]

    def read(seed: Seed, content: bytes) -> object:
        if seed.file == DETAILS:
            (folder / DETAILS).write_bytes(content)
            return showings(folder, facts)
        (folder / DETAILS).write_bytes(arrays)
        try:
            details = json.loads(content)
        except (ValueError, RecursionError):
            raise UserError("not JSON") from None
        return showings(folder, details)

    return seeds, read


@reader("beat network", "beat_net.py")
def _beats(folder: Path) -> Made:
    return of_files(folder, "a.safetensors", [WEIGHTS.read_bytes()], damaged_safetensors, read_beat_net)


@reader("published vocabulary", "published_evaluator.py")
def _published(folder: Path) -> Made:
    whole = {
        "words": ["sos", "eos", "unk", "walk"],
        "classes": ["OTHER", "VERB"],
        "lists": {"VERB": ["walk"]},
    }
    seeds, read = of_files(folder, "a.json", [_json(whole)], damaged_json, _vocabulary)
    return seeds, read


@reader("export", "contract/lookup.py", "store/artifact.py", "store/files.py", "store/text.py")
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


@reader("checkpoint", "checkpointing.py", "stage_module.py", "runs/snapshot.py")
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


@reader("text cache", "text/cache.py", "text/build.py", "text/encoder.py")
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
