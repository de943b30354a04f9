"""Do generated motions do what new wordings say? By geometry, on the clips of a body-only run.

    python benchmarks/wordings_obeyed.py LABELS RUN --known first second --new third loose free

LABELS and the tables of wordings are those of `benchmarks/wordings.py`: RUN is of a model that was trained on
captions of the tables `--known` alone. For every clip of a split whose content geometry can check
(benchmarks/caption_check.py), a sentence about its content and style is put together in each wording, one
motion is made for it, and measured: net turn, speed, which wrist goes up. Beside it how often the recorded
clip passes, and the recorded clip of another row, which is a guess that knows how often each content is asked
for.

With `--judge`, a stage that embeds motion (TMA): how often the nearest recorded clip of the split, by its
latents, has the content, the style, and both. Style has no geometry here. The judge reads motion alone.

Mean ± 95 % interval over the seeds: each words the clips and draws the motions anew. "unseen" are clips whose
pair of content and style is in no training clip.
"""

from __future__ import annotations

import argparse
import json
import random
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch.nn.functional as F
from caption_check import BY_CONTENT
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from torch import Tensor
from wordings import TABLES, Label, Wordings, caption, joined, read_labels

from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import Finished, StageCache
from motionloom.pipeline.evaluation.estimate import estimate
from motionloom.pipeline.evaluation.figures import Estimate
from motionloom.pipeline.evaluation.truth import Truth, truth_of
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.store.networks import embed_motions

Joints = NDArray[np.float64]


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
            "content": float(right[:, 0].value()),
            "style": float(right[:, 1].value()),
            "both": float(right.all(1).mean()),
        }


def shares(clips: Clips, joints: Sequence[Joints]) -> dict[str, float]:
    """Shares of motions that do what was said, all and of new pairs of labels."""
    good = clips.obeyed(joints)
    out = {"obeys": float(good.mean())}
    return out | ({"unseen: obeys": float(good[clips.unseen].value())} if clips.unseen.any() else {})


def measure(
    bundle: Bundle, clips: Clips, wordings: Mapping[str, Wordings], judge: MotionLabels | None,
    *, seeds: int, sampling: SamplingConfig,
) -> dict[str, dict[str, Estimate]]:  # fmt: skip
    """Row -> share -> mean and interval over the seeds."""
    real, out = clips.truths, dict[str, dict[str, Estimate]]()
    known = shares(clips, [t.joints for t in real])
    out["recorded"] = {name: Estimate(value) for name, value in known.items()}
    guesses = []
    for seed in range(seeds):
        other = np.random.default_rng(seed).permutation(len(real))
        guesses.append(shares(clips, [real[i].joints for i in other]))
        if judge is not None:
            guesses[-1] |= judge.shares([real[i].features for i in other])
    out["another clip's"] = over(guesses)
    for name, table in wordings.items():
        rows = []
        for seed in range(seeds):
            draw = random.Random(seed)
            words = [caption(table, label, draw) for label in clips.labels]
            made = bundle.generate(words, seed=seed, sampling=sampling)
            found = shares(clips, [m.joints for m in made])
            rows.append(found if judge is None else found | judge.shares([m.features for m in made]))
        out[name] = over(rows)
    return out


def over(rows: Sequence[Mapping[str, float]]) -> dict[str, Estimate]:
    return {name: estimate([row[name] for row in rows]) for name in rows[0]}


def generators(run: Path, names: Sequence[str] | None) -> list[Finished | None]:
    """Stages of a run that generate, None for its default one."""
    if not names:
        return [None]
    known = finished_stages(run)
    missing = [name for name in names if name not in known]
    if missing:
        raise SystemExit(f"{run}: no finished stage '{missing[0]}'; it has {', '.join(known)}")
    return [known[name] for name in names]


def report(found: Mapping[str, Mapping[str, Estimate]], title: str) -> Table:
    """One row a wording."""
    columns = list(dict.fromkeys(name for row in found.values() for name in row))
    table = Table("wordings", *columns, title=title, title_justify="left")
    for name, row in found.items():
        table.add_row(name, *(said(row[c]) if c in row else "" for c in columns))
    return table


def said(value: Estimate) -> str:
    """With an interval where something was drawn more than once."""
    return f"{value.value:.3f} ± {value.interval:.3f}" if value.interval else f"{value.value:.3f}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("labels", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--data", type=Path, help="run whose stage `data` has the clips (default: RUN)")
    parser.add_argument("--tables", type=Path, default=TABLES)
    parser.add_argument("--known", nargs="+", default=["first", "second"])
    parser.add_argument("--new", nargs="*", default=["third"])
    parser.add_argument("--stage", nargs="+", help="stages that generate (default: the run's own)")
    parser.add_argument("--judge", help="stage of --data's run that embeds motion, such as tma")
    parser.add_argument("--split", default="test")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--top-p", type=float, default=0.95)
    parser.add_argument("--cfg-scale", type=float, default=1.0)
    args = parser.parse_args()
    tables = json.loads(args.tables.read_text(encoding="utf-8"))["tables"]
    for name in [*args.known, *args.new]:
        if name not in tables:
            parser.error(f"{args.tables}: no table '{name}'; it has {', '.join(tables)}")
    wordings = {"known": joined(tables, args.known), **{name: tables[name] for name in args.new}}
    stages, stage_cache = finished_stages(args.data or args.run), StageCache()
    clips = Clips(stage_cache.get(stages["data"]), read_labels(args.labels), args.split)
    judge = MotionLabels(stage_cache.get(stages[args.judge]), clips) if args.judge else None
    sampling = SamplingConfig(top_p=args.top_p, cfg_scale=args.cfg_scale)
    console, results = Console(width=160), {}
    for stage in generators(args.run, args.stage):
        bundle = Bundle.open(args.run) if stage is None else Bundle([stage], stage_cache)
        name = args.run.name if stage is None else stage.name
        found = measure(bundle, clips, wordings, judge, seeds=args.seeds, sampling=sampling)
        title = f"{name}: {len(clips.truths)} {args.split} clips, {int(clips.unseen.sum())} of unseen pairs"
        console.print(report(found, title))
        results[name] = {
            row: {key: [value.mean, value.half_width] for key, value in columns.items()}
            for row, columns in found.items()
        }
    (args.run / "wordings_obeyed.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
