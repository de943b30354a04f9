"""Does a trained model's help last? Fine-tuning against training from nothing, for equal processor time.

    motionloom data convert bvh mocap shards --captions mocap/captions.jsonl --licence CC-BY-NC-4.0 \
      --set layout=wholebody363 --set fingers=resting
    python benchmarks/finetuning.py LABELS WORK --data shards --start synthetic --judge runs/bvh-body

`scratch` trains tokenizer, TMA and GPT from new weights, with the data's own statistics. `tuned` trains
networks of the same sizes on from those of `--start`. Both have the same clips, and `--seconds` of processor
time for their three trainings: what a step costs is measured first, and the seconds that were really taken
are reported. Each arm takes the best of the same number of learning rates of its GPT (`--rates`, times its
recipe's), by its cross-entropy on held-out clips with a seed of its
own (`--search-seed`).

One motion is made for the first caption of every test clip. They are judged by what no arm was trained with:
retrieval among 32 by another run's TMA, which reads the body alone (`--judge`); the labels of the nearest
recorded clip by its latents; and by geometry whether the motion does what the clip is labelled with
(caption_check.py). LABELS is a JSON lines file with `id`, `content` and `style` of the clips. Beside them:
recorded motion, another clip's, and what `--start` makes before it is trained.

Killed and started again it goes on where it was.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch.nn.functional as F
from bench import Column, arguments, command_line, kept, process_seconds, report, train
from caption_check import BY_CONTENT
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.motion.canonical import canonicalize
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.layout import BODY_JOINTS, MotionLayout
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.latent_metrics import LatentRow, recalls
from motionloom.pipeline.evaluation.truth import Truth, truth_of
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.generation import generate
from motionloom.pipeline.inference.request import Request
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.store.evaluator import embed_motions
from motionloom.pipeline.store.training_log import read_training_log
from motionloom.pipeline.store.yaml import dump_yaml

Joints = NDArray[np.float64]

STAGES = ("tokenizer", "tma", "gpt")
ARMS: dict[str, dict[str, tuple[float, float]]] = {
    "scratch": {"tokenizer": (0.35, 2.0e-3), "tma": (0.15, 5.0e-4), "gpt": (0.50, 1.0e-3)},
    "tuned": {"tokenizer": (0.25, 1.0e-3), "tma": (0.15, 5.0e-4), "gpt": (0.60, 5.0e-4)},
}
"""Arm -> training -> its share of the time, and its learning rate."""
BATCH = {"tokenizer": 32, "tma": 32, "gpt": 16}
SIZE = 32
COLUMNS = (
    *(
        Column(figure, figure, 1, 100)
        for figure in ("t2m_r1", "t2m_r3", "m2t_r1", "content", "style", "obeys")
    ),
    Column("seconds", "seconds", 0),
)
PROBE = (10, 40)
"""Steps of the two trainings whose difference says what a step costs."""
Label = tuple[str, str]
"""Content and style of a clip."""


def read_labels(path: Path) -> dict[str, Label]:
    """Content and style by the clips' ids."""
    rows = (json.loads(line) for line in path.read_text(encoding="utf-8").splitlines())
    return {row["id"]: (row["content"], row["style"]) for row in rows}


class Clips:
    """The test clips, and what judges motions that are made for them."""

    def __init__(self, args: argparse.Namespace, data: Any, labels: Mapping[str, Label]) -> None:
        dataset = data.split("test")
        found = [truth_of(dataset, i) for i in range(len(dataset))]
        self.truths: list[Truth] = found[: args.tested or None]
        self.labels = np.array([labels[t.id] for t in self.truths])
        self.captions = [t.caption for t in self.truths]
        self.fps: float = dataset.layout.fps
        self.layout = MotionLayout.named("body133", fps=self.fps)
        judge = finished_stages(args.judge)["tma"]
        stage_cache = StageCache()
        self._tma = stage_cache.get(judge)
        self._text = self._tma.embed_captions(self.captions, stage_cache.given(judge.inputs)["text"].cache)
        self._recorded = self.latents([t.joints for t in self.truths])

    def latents(self, joints: Sequence[Joints]) -> Tensor:
        """The judge's latents of motions, by their bodies alone."""
        bodies = [encode(canonicalize(j[:, :BODY_JOINTS]), self.layout) for j in joints]
        return F.normalize(embed_motions(self._tma, bodies).double(), dim=-1)

    def figures(self, joints: Sequence[Joints], skip_own: bool = False) -> dict[str, float]:
        """Shares of motions [n], one for each clip; `skip_own` where they are the clips themselves."""
        latent = self.latents(joints)
        found = [recalls(LatentRow(self._text, latent, latent, seed, SIZE)) for seed in range(10)]
        near = latent @ self._recorded.T
        if skip_own:
            near.fill_diagonal_(-2)
        right = self.labels[near.argmax(1).numpy()] == self.labels
        obeyed = [
            BY_CONTENT[content](j[:, :BODY_JOINTS], self.fps)
            for j, (content, _) in zip(joints, self.labels, strict=True)
            if content in BY_CONTENT
        ]
        out = {name: float(np.mean([one[name] for one in found])) for name in found[0]}
        return out | {
            "content": float(right[:, 0].mean()),
            "style": float(right[:, 1].mean()),
            "obeys": float(np.mean(obeyed)),
        }


def base(args: argparse.Namespace) -> Path:
    """A run with the clips and their captions, which all arms read."""
    data = {"kind": "shards", "path": str(args.data.resolve()), "verify": False}
    stages = {"data": data, "stats": {"kind": "stats"}, "text": {"kind": "text"}}
    return train(args.work / "base", stages, seed=1)


def arm_recipe(
    args: argparse.Namespace, arm: str, seed: int, steps: Mapping[str, int], rate: float
) -> dict[str, Any]:
    """The three trainings of an arm; the GPT's learning rate is multiplied by `rate`."""
    read = {"data": str(args.work.resolve() / "base/stages/data")}
    text = {"text": str(args.work.resolve() / "base/stages/text")}
    stages: dict[str, Any] = {name: {} for name in STAGES} | {"tokens": {"kind": "tokens"}}
    recipe: dict[str, Any] = {"seed": seed, "stages": stages}
    recipe["start"] = str(args.start.resolve()) if args.start.is_dir() else str(args.start)
    if arm == "scratch":  # the sizes of the model, none of its weights
        path = args.work / "sizes.yaml"
        path.write_text(dump_yaml({"name": "sizes", **recipe, "stages": stages_of(stages, read, text)}))
        sizes = load_recipe(path)
        for name in STAGES:
            stage = sizes.stage(name)
            settings = {k: v for k, v in stage.config.dump().items() if k not in ("optim", "train")}
            stages[name] = {"kind": stage.kind.name, **settings}
        own = {"stats": str(args.work.resolve() / "base/stages/stats")}
        del recipe["start"]
        stages["tokens"]["inputs"] = dict(own)
        for name in ("tokenizer", "tma"):
            stages[name]["inputs"] = dict(own)
    for name in STAGES:
        lr = ARMS[arm][name][1] * (rate if name == "gpt" else 1.0)
        stages[name]["optim"] = {"lr": lr, "warmup_steps": min(50, steps[name] // 5), "schedule": "cosine"}
        every = max(1, steps[name] // 4)
        length = {"steps": steps[name], "batch_size": BATCH[name]}
        stages[name]["train"] = {**length, "checkpoint_every": every, "validate_every": every}
    stages["gpt"]["loss"] = {"align_weight": 0.0}
    return {**recipe, "stages": stages_of(stages, read, text)}


def stages_of(stages: dict[str, Any], data: dict[str, str], text: dict[str, str]) -> dict[str, Any]:
    """The stages with the inputs that lie in the base run."""
    needs = {name: data | (text if name in ("tma", "gpt") else {}) for name in stages}
    return {
        name: {**entry, "inputs": {**needs[name], **entry.get("inputs", {})}}
        for name, entry in stages.items()
    }


def train_arm(recipe: dict[str, Any], folder: Path) -> dict[str, float]:
    """Run an arm, stage by stage; processor seconds of its trainings, those of an earlier, killed run too."""
    log = folder.parent / f"{folder.name}.seconds.json"
    taken: dict[str, float] = json.loads(log.read_text()) if log.is_file() else {}
    for name in ("tokenizer", "tma", "tokens", "gpt"):
        begin = process_seconds()
        train(folder, until=name, **recipe)
        if name in STAGES:
            seconds = process_seconds() - begin
            if name not in taken or seconds > 20:  # planning alone takes a second or two
                taken[name] = taken.get(name, 0.0) + seconds
            log.write_text(json.dumps(taken))
    return taken


def costs(args: argparse.Namespace) -> dict[str, float]:
    """Processor seconds of a step of each training."""
    out: dict[str, float] = {}
    for name in STAGES:
        spent = []
        for steps in PROBE:
            folder = args.work / "probe"
            recipe = arm_recipe(args, "tuned", 0, dict.fromkeys(STAGES, PROBE[0]) | {name: steps}, 1.0)
            if name == "gpt":
                train(folder, until="tma,tokens", **recipe)
            begin = process_seconds()
            train(folder, until=name, force=True, **recipe)
            spent.append(process_seconds() - begin)
        out[name] = (spent[1] - spent[0]) / (PROBE[1] - PROBE[0])
    return out


def steps_of(args: argparse.Namespace, arm: str, cost: Mapping[str, float]) -> dict[str, int]:
    """Steps that fill the time."""
    out = {}
    for name, (share, _) in ARMS[arm].items():
        out[name] = max(20, round(args.seconds * share / cost[name] / 10) * 10)
    return out


def best_rate(args: argparse.Namespace, arm: str, steps: Mapping[str, int]) -> float:
    """The rate whose GPT predicts held-out clips best, with the search's seed."""
    if len(args.rates) == 1:
        return float(args.rates[0])

    def loss(rate: float) -> float:
        folder = args.work / "search" / arm
        train_arm(arm_recipe(args, arm, args.search_seed, steps, rate), folder)
        return [row["val/ce"] for row in read_training_log(folder / "stages/gpt") if "val/ce" in row][-1]

    files = {rate: args.work / f"search-{arm}-{rate:g}.json" for rate in args.rates}
    return min(files, key=lambda rate: kept(files[rate], lambda: loss(rate)))


def figures_of(bundle: Bundle, clips: Clips, seed: int, args: argparse.Namespace) -> dict[str, float]:
    """Figures of motions for the captions."""
    sampling = SamplingConfig(top_p=args.top_p, cfg_scale=args.cfg_scale)
    made = generate(bundle, Request.of(clips.captions, seed=seed, sampling=sampling))
    return clips.figures([m.joints for m in made])


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("labels", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--data", type=Path, help="shards of the clips, in the layout of the model")
    parser.add_argument("--start", type=Path, default=Path("synthetic"), help="the model to go on from")
    parser.add_argument("--judge", type=Path, help="a run with a TMA in layout body133 on the same clips")
    parser.add_argument("--seconds", type=float, default=300.0, help="processor seconds of the trainings")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--rates", type=float, nargs="+", default=[0.3, 1.0, 3.0])
    parser.add_argument("--search-seed", type=int, default=100)
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=list(ARMS))
    parser.add_argument("--tested", type=int, default=0, help="test clips to generate for; 0 for all")
    parser.add_argument("--top-p", type=float, default=0.95)
    parser.add_argument("--cfg-scale", type=float, default=1.0)
    args = arguments(parser)
    data = StageCache().get(finished_stages(base(args))["data"])
    clips = Clips(args, data, read_labels(args.labels))
    recorded = [truth.joints for truth in clips.truths]
    found: dict[str, list[dict[str, float]]] = {}

    def measure(row: str, seed: int, figures: Callable[[], dict[str, float]]) -> None:
        found.setdefault(row, []).append(kept(args.work / f"figures-{row}-{seed}.json", figures))

    def other(seed: int) -> dict[str, float]:
        order = np.random.default_rng(seed).permutation(len(recorded))
        return clips.figures([recorded[i] for i in order])

    def arm_figures(arm: str, seed: int) -> dict[str, float]:
        recipe = arm_recipe(args, arm, seed, steps[arm], rates[arm])
        folder = args.work / f"{arm}-{seed}"
        seconds = sum(train_arm(recipe, folder).values())
        return figures_of(Bundle.open(folder), clips, seed, args) | {"seconds": seconds}

    measure("recorded", 0, lambda: clips.figures(recorded, skip_own=True))
    for seed in args.seeds:
        measure("another clip's", seed, lambda seed=seed: other(seed))
        if args.arms != ["scratch"]:  # which takes the model's sizes alone
            measure("as it came", seed, lambda s=seed: figures_of(Bundle.open(args.start), clips, s, args))
    cost = kept(args.work / "costs.json", lambda: costs(args))
    steps = {arm: steps_of(args, arm, cost) for arm in args.arms}
    rates = {arm: best_rate(args, arm, steps[arm]) for arm in args.arms}
    for seed in args.seeds:
        for arm in args.arms:
            measure(arm, seed, lambda arm=arm, seed=seed: arm_figures(arm, seed))
    figures = [column.figure for column in COLUMNS]
    rows = [
        {
            "title": f"{arm}, GPT's rate × {rates[arm]:g}" if arm in rates else arm,
            "cells": {f: [one[f] for one in each] for f in figures if f in each[0]},
            "seeds": args.seeds,
        }
        for arm, each in found.items()
    ]
    report(f"Fine-tuning, {args.seconds:g} s", COLUMNS, rows, args.record)


if __name__ == "__main__":
    main()
