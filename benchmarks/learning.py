"""The learning proofs on a finished (or half finished) run of `humantomato-learning`, from its test split.

    motionloom run humantomato-learning
    python benchmarks/learning.py runs/humantomato-learning [--without RUN ...]

- Retrieval among 32 clips that all do something different (no two have the same truth), both ways.
- What the captions of opposite motions look like to TMA and to the frozen sentence encoder.
- Motions generated for held-out combinations of known words, measured on their joints.

`--without` names further runs to put beside, for instance one trained without the filter of negatives
(`--set tma.loss.threshold=1.0`).
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from motionloom.datasets.shards.statistics import FeatureStats
from motionloom.datasets.synth.measure import agrees
from motionloom.datasets.text.encoder import load_text_encoder
from motionloom.models.metrics.retrieval import recall
from motionloom.pipeline.bundle import Bundle, text_encoder_of
from motionloom.pipeline.evaluation import embed_motions
from motionloom.pipeline.networks import LoadedTma
from motionloom.pipeline.samples import Truth, truth_of
from motionloom.pipeline.sources import open_split, open_text

PAIRS = (
    ("a person walks in a clockwise circle", "a person walks in a counter-clockwise circle"),
    ("a person walks forward", "a person walks backward"),
    ("a person turns to the left", "a person turns to the right"),
    ("a person kicks with the left leg", "a person kicks with the right leg"),
    ("a person jumps up once", "a person jumps up three times"),
)
SIZE = 32


def test_truths(run: Path) -> list[Truth]:
    dataset = open_split(run / "stages/data", "test")
    return [truth_of(dataset, i) for i in range(len(dataset))]


def told(truth: Truth) -> str:
    """What a clip does, as its body captions can say it: the face is told elsewhere, the style nowhere."""
    record = {k: v for k, v in (truth.truth or {}).items() if k not in ("face", "style")}
    return json.dumps(record, sort_keys=True)


def retrieval(run: Path, truths: list[Truth], draws: int) -> dict[str, float]:
    """Mean recall over draws of 32 clips with different truths."""
    stages = run / "stages"
    tma, cache = LoadedTma.load(stages / "tma"), open_text(stages / "text")
    stats = FeatureStats.load(stages / "stats/stats.safetensors")
    text = tma.embed_captions([t.caption for t in truths], cache)
    motion = embed_motions(tma, stats, [t.features for t in truths])
    kinds: dict[str, list[int]] = defaultdict(list)
    for row, truth in enumerate(truths):
        kinds[told(truth)].append(row)
    rng = np.random.default_rng(0)
    found: dict[str, list[float]] = defaultdict(list)
    names = sorted(kinds)
    for _ in range(draws):
        chosen = [int(rng.choice(kinds[names[k]])) for k in rng.permutation(len(names))[:SIZE]]
        for name, value in recall(text[chosen], motion[chosen]).items():
            found[name].append(value)
    return {name: float(np.mean(values)) for name, values in found.items()} | {"kinds": len(names)}


def similarities(run: Path) -> list[tuple[str, str, float, float]]:
    """(caption, caption, cosine of the sentence encoder, cosine of TMA)."""
    tma = LoadedTma.load(run / "stages/tma")
    encoder = load_text_encoder(text_encoder_of(run / "stages/text"))
    rows = []
    for one, other in PAIRS:
        encoded = encoder.encode([one, other])
        latent = tma.embed_text(torch.as_tensor(encoded.tokens), torch.as_tensor(encoded.mask))
        pair = (torch.as_tensor(encoded.sentence), latent)
        cosines = [float(torch.nn.functional.cosine_similarity(v[0], v[1], dim=0)) for v in pair]
        rows.append((one, other, *cosines))
    return rows


def generation(
    run: Path, truths: list[Truth], hold_out: list[dict[str, Any]], repeats: int
) -> dict[str, Any]:
    """Share of right attributes of generated motions, of held-out combinations and of other test clips."""
    bundle = Bundle.open(run)
    rows: dict[str, dict[str, list[bool]]] = {"held out": defaultdict(list), "other": defaultdict(list)}
    for repeat in range(repeats):
        motions = bundle.generate(
            [t.caption for t in truths], face_captions=[t.face_caption for t in truths], seed=repeat
        )
        for truth, made in zip(truths, motions, strict=True):
            record = truth.truth or {}
            apart = any(all(record.get(k) == v for k, v in c.items()) for c in hold_out)
            kind = rows["held out" if apart else "other"]
            for name, right in agrees(record, made.joints, made.face, made.layout.fps).items():
                kind[name].append(right)
    return {kind: {name: float(np.mean(v)) for name, v in found.items()} for kind, found in rows.items()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--without", type=Path, nargs="*", default=[])
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=1)
    args = parser.parse_args()
    console, truths = Console(), test_truths(args.run)
    table = Table("run", "text to motion R@1", "R@3", "motion to text R@1", "R@3")
    for run in (args.run, *args.without):
        found = retrieval(run, truths, args.draws)
        keys = ("t2m/R@1", "t2m/R@3", "m2t/R@1", "m2t/R@3")
        table.add_row(run.name, *(f"{100 * found[key]:.1f} %" for key in keys))
    table.title = f"retrieval among {SIZE} different motions, {len(truths)} test clips; a guess: 3.1 %, 9.4 %"
    console.print(table)
    table = Table("caption", "caption", "sentence encoder", "TMA", title="cosine of opposite captions")
    for one, other, sentence, aligned in similarities(args.run):
        table.add_row(one, other, f"{sentence:.2f}", f"{aligned:.2f}")
    console.print(table)
    if (args.run / "stages/gpt/artifact.json").is_file():
        recipe = json.loads((args.run / "stages/data/artifact.json").read_text())
        shares = generation(args.run, truths, recipe["config"]["hold_out"], args.repeats)
        names = sorted({*shares["held out"], *shares["other"]})
        table = Table("attribute", *shares, title="generated motions that do what the caption says")
        for name in names:
            table.add_row(
                name, *(f"{100 * shares[k][name]:.0f} %" if name in shares[k] else "" for k in shares)
            )
        console.print(table)


if __name__ == "__main__":
    main()
