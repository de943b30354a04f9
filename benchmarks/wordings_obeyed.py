"""Do generated motions do what new wordings say? By geometry, on the clips of a body-only run.

    python benchmarks/wordings_obeyed.py LABELS RUN --write-captions captions.jsonl --known first second
    motionloom run bvh-body --set data.captions=captions.jsonl ...
    python benchmarks/wordings_obeyed.py LABELS RUN --known first second --new third loose free

LABELS is a JSON lines file that names `id`, `content` and `style` of every clip, such as the
`captions.jsonl` of the real clips in docs/results.md. `wordings.json` beside this script holds the wordings
in tables: what may be said of each content and style, and how a sentence is put together. The first command
writes LABELS with other captions, four a clip, of the tables `--known` alone; a model that is trained on
those has never seen the others. For every clip of a split whose content geometry can check
(benchmarks/caption_check.py), a sentence about its content and style is put together in each wording, one
motion is made for it, and measured: net turn, speed, which wrist goes up. Beside it how often the recorded
clip passes, and the recorded clip of another row, which is a guess that knows how often each content is asked
for.

With `--judge`, a stage that embeds motion (TMA): how often the nearest recorded clip of the split, by its
latents, has the content, the style, and both. Style has no geometry here. The judge reads motion alone.

Each seed words the clips and draws the motions anew. "unseen" are clips whose pair of content and style is in
no training clip.
"""

from __future__ import annotations

import json
import random
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch.nn.functional as F
from bench import Column, arguments, command_line, report
from caption_check import BY_CONTENT
from numpy.typing import NDArray
from torch import Tensor

from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.truth import Truth, truth_of
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.store.evaluator import embed_motions

TABLES = Path(__file__).with_name("wordings.json")
CAPTIONS = 4
"""Captions a clip that are written for training."""
Joints = NDArray[np.float64]
Wordings = Mapping[str, Any]
Label = tuple[str, str]
"""Content and style of a clip."""


def joined(tables: Mapping[str, Wordings], names: Sequence[str]) -> Wordings:
    """One table of all wordings of the named ones; the sentences are put together as in the first."""
    first = tables[names[0]]
    content: dict[str, dict[str, list[str]]] = {}
    style: dict[str, list[str]] = {}
    for name in names:
        for label, forms in tables[name]["content"].items():
            mine = content.setdefault(label, {"v": [], "ing": []})
            for form in mine:
                mine[form] = [*mine[form], *forms[form]]
        for label, phrases in tables[name]["style"].items():
            style[label] = [*style.get(label, []), *phrases]
    return {**first, "content": content, "style": style}


def caption(wordings: Wordings, label: Label, draw: random.Random) -> str:
    """One sentence about a content and a style, lower case."""
    content, style = label
    forms, phrases = wordings["content"][content], wordings["style"][style]
    choices = list(wordings["templates"])
    if style == "normal":  # what is normal need not be said
        choices += wordings["templates_plain"]
    usable = [t for t in choices if all(forms[form] for form in ("v", "ing") if "{" + form + "}" in t)]
    fields = {form: draw.choice(forms[form]) for form in ("v", "ing") if forms[form]}
    manner = draw.choice(phrases)
    fields |= {"S": draw.choice(wordings["subjects"]), "A": manner, "A_cap": manner}
    said: str = draw.choice(usable).format(**fields)
    return said.lower()


def write_captions(labels: Path, wordings: Wordings, target: Path) -> None:
    """The rows of `labels` with captions of these wordings, decided by each clip's id."""
    rows = [json.loads(line) for line in labels.read_text(encoding="utf-8").splitlines()]
    with target.open("w", encoding="utf-8") as file:
        for row in rows:
            draw, label = random.Random(row["id"]), (row["content"], row["style"])
            said = [caption(wordings, label, draw) for _ in range(CAPTIONS)]
            file.write(json.dumps({**row, "captions": said}, ensure_ascii=False) + "\n")


def read_labels(path: Path) -> dict[str, Label]:
    """Content and style by the clips' ids."""
    rows = (json.loads(line) for line in path.read_text(encoding="utf-8").splitlines())
    return {row["id"]: (row["content"], row["style"]) for row in rows}


class Clips:
    """The clips of a split that geometry can check, their labels, and which pairs of labels are new."""

    def __init__(self, data: Any, labels: Mapping[str, Label], split: str) -> None:
        dataset = data.split(split)
        found = [truth_of(dataset, i) for i in range(len(dataset))]
        self.truths: list[Truth] = [t for t in found if labels[t.id][0] in BY_CONTENT]
        self.labels = [labels[t.id] for t in self.truths]
        trained = {labels[i] for i in data.split("train").ids}
        self.unseen = np.array([label not in trained for label in self.labels])
        self.fps: float = dataset.layout.fps

    def obeyed(self, joints: Sequence[Joints]) -> NDArray[np.bool_]:
        """Whether each motion does what the clip of its row is labelled with, bool [n]."""
        rows = zip(joints, self.labels, strict=True)
        return np.array([BY_CONTENT[content](j, self.fps) for j, (content, _) in rows])


class MotionLabels:
    """Labels of motions: those of the nearest recorded clip by a judge's latents."""

    def __init__(self, tma: Any, clips: Clips) -> None:
        self._tma, self._clips = tma, clips
        self._recorded = self._embed([t.features for t in clips.truths])

    def _embed(self, motions: Sequence[NDArray[np.float32]]) -> Tensor:
        return F.normalize(embed_motions(self._tma, list(motions)).double(), dim=-1)

    def shares(self, motions: Sequence[NDArray[np.float32]]) -> dict[str, float]:
        """How often the nearest clip has the content, the style and both of the row."""
        near = (self._embed(motions) @ self._recorded.T).argmax(1).tolist()
        found = np.array([self._clips.labels[i] for i in near])
        right = found == np.array(self._clips.labels)
        return {
            "content": float(right[:, 0].mean()),
            "style": float(right[:, 1].mean()),
            "both": float(right.all(1).mean()),
        }


def shares(clips: Clips, joints: Sequence[Joints]) -> dict[str, float]:
    """Shares of motions that do what was said, all and of new pairs of labels."""
    good = clips.obeyed(joints)
    out = {"obeys": float(good.mean())}
    return out | ({"unseen: obeys": float(good[clips.unseen].mean())} if clips.unseen.any() else {})


def measure(
    bundle: Bundle, clips: Clips, wordings: Mapping[str, Wordings], judge: MotionLabels | None,
    *, seeds: int, sampling: SamplingConfig,
) -> dict[str, list[dict[str, float]]]:  # fmt: skip
    """Row -> shares of each seed."""
    real = clips.truths
    out = {"recorded": [shares(clips, [t.joints for t in real])], "another clip's": []}
    for seed in range(seeds):
        other = np.random.default_rng(seed).permutation(len(real))
        found = shares(clips, [real[i].joints for i in other])
        out["another clip's"].append(
            found | (judge.shares([real[i].features for i in other]) if judge else {})
        )
    for name, table in wordings.items():
        for seed in range(seeds):
            draw = random.Random(seed)
            words = [caption(table, label, draw) for label in clips.labels]
            made = bundle.generate(words, seed=seed, sampling=sampling)
            found = shares(clips, [m.joints for m in made])
            found |= judge.shares([m.features for m in made]) if judge else {}
            out.setdefault(name, []).append(found)
    return out


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("labels", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--write-captions", type=Path, help="write these captions, and measure nothing")
    parser.add_argument("--known", nargs="+", default=["first", "second"])
    parser.add_argument("--new", nargs="*", default=["third"])
    parser.add_argument("--judge", help="stage of the run that embeds motion, such as tma")
    parser.add_argument("--split", default="test")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--top-p", type=float, default=0.95)
    parser.add_argument("--cfg-scale", type=float, default=1.0)
    args = arguments(parser)
    tables = json.loads(TABLES.read_text(encoding="utf-8"))["tables"]
    for name in [*args.known, *args.new]:
        if name not in tables:
            parser.error(f"{TABLES}: no table '{name}'; it has {', '.join(tables)}")
    known = joined(tables, args.known)
    if args.write_captions is not None:
        write_captions(args.labels, known, args.write_captions)
        return
    stages, stage_cache = finished_stages(args.run), StageCache()
    clips = Clips(stage_cache.get(stages["data"]), read_labels(args.labels), args.split)
    judge = MotionLabels(stage_cache.get(stages[args.judge]), clips) if args.judge else None
    wordings = {"known": known, **{name: tables[name] for name in args.new}}
    sampling = SamplingConfig(top_p=args.top_p, cfg_scale=args.cfg_scale)
    found = measure(Bundle.open(args.run), clips, wordings, judge, seeds=args.seeds, sampling=sampling)
    columns = [Column(name, name, 3) for name in dict.fromkeys(k for rows in found.values() for k in rows[0])]
    protocol = {"split": args.split, "clips": len(clips.truths), "unseen pairs": int(clips.unseen.sum())}
    rows = [
        {"title": name, "cells": {k: [one[k] for one in each] for k in each[0]}, "protocol": protocol}
        for name, each in found.items()
    ]
    report(f"Unseen wordings of {args.run.name}", columns, rows, args.record)


if __name__ == "__main__":
    main()
