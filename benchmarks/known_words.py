"""Does a model know what it does not know? Everyday sentences, what it makes of them, and what is noted.

    python benchmarks/known_words.py synthetic --record known_words

One motion is made for each sentence of `known_words.yaml` and measured on its joints: does it do what is
said? A good note is about a motion that does not. Compared are the notes of the package, by patterns of
English and rules on joints, with a linear probe that tells from the sentence embedding which action is asked
for, and with the distance to the training's captions. Probe and distances are noted at whichever limits do
best on these very sentences, with no more false alarms than the patterns have: that flatters them.
What joints show is told by rules that judge here too.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import yaml
from bench import Column, arguments, command_line, report
from model_card import noted, synthetic_data
from numpy.typing import NDArray
from rich.console import Console
from sklearn.linear_model import LogisticRegression
from sklearn.multiclass import OneVsRestClassifier
from torch.nn import functional as F

from motionloom.datasets.actions.measure import action_of, actions_of, agrees, find_mismatch
from motionloom.datasets.synth.generate import captions_of, split_of, truth_of
from motionloom.datasets.synth.requests import attributes_of
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.shipped_models import model_folder
from motionloom.pipeline.runs.recipe import load_recipe

SENTENCES = Path(__file__).with_suffix(".yaml")
CAPTIONS = 6000
"""Training captions that the probe learns from."""
LIMITS = 61
"""Limits of each score that are tried."""
PATTERNS, PROBE = "patterns and joints", "linear probe, joints and distance"
Flags = NDArray[np.bool_]


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument(
        "model", type=Path, help="a run, an exported folder, or the name of a model of the package"
    )
    parser.add_argument("--seed", type=int, default=0)
    args = arguments(parser)
    groups = yaml.safe_load(SENTENCES.read_text(encoding="utf-8"))
    rows = [row for sentences in groups.values() for row in sentences]
    captions = [caption for caption, _ in rows]
    model, console = model_folder(args.model), Console(soft_wrap=True)
    bundle = Bundle.open(model)
    motions = bundle.generate(captions, seed=args.seed)
    right = np.array(
        [truth is not None and all(agrees(truth, motion.joints, None, motion.fps).values())
         for (_, truth), motion in zip(rows, motions, strict=True)]
    )  # fmt: skip
    unknown = {one.caption for one in bundle.unknown_captions(captions)}
    flags = {
        PATTERNS: np.array(
            [caption in unknown or bool(bundle.find_mismatches([motion]))
             for caption, motion in zip(captions, motions, strict=True)]
        )
    }  # fmt: skip
    for caption, motion, good, flag in zip(captions, motions, right, flags[PATTERNS], strict=True):
        if good == flag:
            shows = action_of(motion.joints, motion.fps)
            console.print(f"{'noted, and right' if good else 'not noted, and wrong'}: '{caption}' ({shows})")
    flags |= others(bundle, model, captions, motions, right, int(flags[PATTERNS][right].sum()))
    facts = {"sentences": len(rows), "wrong": int((~right).sum()), "right": int(right.sum())}
    record = [
        {
            "title": title,
            "cells": {"wrong": [float(flag[~right].mean())], "right": [float(flag[right].mean())]},
            "seeds": [],
            "protocol": facts,
        }
        for title, flag in flags.items()
    ]
    columns = [Column(f"{name} motions noted, %", name, 1, 100) for name in ("wrong", "right")]
    report("Notes on everyday sentences", columns, record, args.record)


def others(bundle, model, captions, motions, right: Flags, alarms: int) -> dict[str, Flags]:
    """Return the flags of the probe and of distances, at their best limits with at most so many alarms."""
    card = noted(model)
    config = synthetic_data(load_recipe(card["recipe"], card.get("settings", []), strict=False))[0]
    train = [index for index in range(config.clips) if split_of(index, config) == "train"]
    chosen = {
        captions_of(index, config)[0][0]: actions_of(truth_of(index, config).record(hands=True, face=True))
        for index in np.random.default_rng(0).permutation(train)[:CAPTIONS].tolist()
    }
    source, tma = bundle.generator.prepared["text"], bundle.generator.reranker

    def latents(texts: list[str]) -> NDArray[np.float32]:
        return F.normalize(tma.embed_captions(texts, source), dim=-1).numpy()

    def sentences(texts: list[str]) -> NDArray[np.float32]:
        blocks = [texts[start : start + 64] for start in range(0, len(texts), 64)]
        return np.concatenate([source.encoder.encode(block).sentence for block in blocks])

    known = source.known["body"]
    embedded = sentences(captions)
    near = (embedded @ known.embeddings.T).max(axis=1)
    near_read = (latents(captions) @ latents(list(known.captions)).T).max(axis=1)
    names = sorted({action for actions in chosen.values() for action in actions})
    wanted = np.array([[name in actions for name in names] for actions in chosen.values()])
    probe = OneVsRestClassifier(LogisticRegression(max_iter=500, C=10.0))
    chances = probe.fit(sentences(list(chosen)), wanted).predict_proba(embedded)
    likely, differs = [], []
    for text, motion, row in zip(captions, motions, chances, strict=True):
        shown = action_of(motion.joints, motion.fps)
        asked = [names[k] for k in np.flatnonzero(row > 0.5)]
        both = {"action": "then", "parts": [{"action": action} for action in asked]}
        if len(asked) == 2:
            orders = [both, {**both, "parts": both["parts"][::-1]}]
            likely.append(float(find_mismatch(orders, motion.joints, motion.fps) is None))
        else:
            likely.append(row[names.index(shown)] if shown in names else 0.0)
        request = attributes_of(text, shown)  # side and count by their words
        differs.append(shown != "then" and find_mismatch([request], motion.joints, motion.fps) is not None)
    likely, differs = np.array(likely), np.array(differs)

    def best(tried: list[Flags]) -> Flags:
        allowed = [flag for flag in tried if flag[right].sum() <= alarms]
        return max(allowed, key=lambda flag: flag[~right].sum())

    steps = np.linspace(0, 1, LIMITS)
    limits = {name: np.quantile(x, steps) for name, x in (("near", near), ("read", near_read), ("p", likely))}
    return {
        PROBE: best([(likely < p) | (near < n) | differs for p, n in product(limits["p"], limits["near"])]
                    + [(likely < p) | (near < n) for p, n in product(limits["p"], limits["near"])]),
        "distance alone, sentence embeddings": best([near < limit for limit in limits["near"]]),
        "distance alone, TMA's latents": best([near_read < limit for limit in limits["read"]]),
    }  # fmt: skip


if __name__ == "__main__":
    main()
