"""What TMA's embeddings say about each attribute, also in combinations that training never showed.

    python benchmarks/probe.py runs/humantomato-learning

A linear reader (logistic regression) learns every attribute of the truth from the embeddings of training
captions, or motions, and is asked about test clips: those of held-out combinations that the attribute
belongs to, and the others. What it cannot read in the captions' embeddings no GPT can do, and what the
motions' do not say the captions' cannot learn from them. The sentence embedding stands beside them.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from learning import test_truths
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from sklearn.linear_model import LogisticRegression

from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.truth import Truth, has_caption, truth_of
from motionloom.pipeline.store.networks import embed_motions

ATTRIBUTES = ("action", "direction", "side", "count", "speed", "left_hand", "right_hand")


def shares(
    train: tuple[list[Truth], NDArray[np.float32]],
    test: tuple[list[Truth], NDArray[np.float32]],
    name: str,
    hold_out: list[dict[str, Any]],
) -> tuple[float, float]:
    """Right answers about one attribute: of held-out combinations with it, and of the other clips.

    Relaxed hands are left out: captions do not name them.
    """

    def told(truths: list[Truth]) -> NDArray[np.bool_]:
        return np.array([(t.truth or {}).get(name) not in (None, "relaxed") for t in truths])

    def values(truths: list[Truth]) -> NDArray[np.str_]:
        return np.array([str((t.truth or {}).get(name)) for t in truths])

    learns = told(train[0]) if not name.endswith("_hand") else np.ones(len(train[0]), bool)
    reader = LogisticRegression(max_iter=500, C=10.0).fit(train[1][learns], values(train[0])[learns])
    right = reader.predict(test[1]) == values(test[0])
    apart = np.array(
        [
            any(name in c and all((t.truth or {}).get(k) == v for k, v in c.items()) for c in hold_out)
            for t in test[0]
        ]
    )
    asked = told(test[0])
    held, other = right[apart & asked], right[~apart & asked]
    return float(held.mean()) if len(held) else np.nan, float(other.mean())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--train", type=int, default=3000, help="training captions the reader learns from")
    args = parser.parse_args()
    stages, stage_cache = finished_stages(args.run), StageCache()
    hold_out = [c for stage in stages.values() for c in getattr(stage.config, "hold_out", [])]
    split = stage_cache.get(stages["data"]).split("train")
    captioned = has_caption(split).nonzero()[0]
    chosen = np.random.default_rng(1).permutation(captioned)[: args.train]
    asked = [t for t in test_truths(args.run) if t.caption and t.truth and t.truth["action"] != "dance"]
    truths = [truth_of(split, int(i)) for i in chosen], asked
    tma, cache = stage_cache.get(stages["tma"]), stage_cache.get(stages["text"]).cache
    readers: dict[str, list[NDArray[np.float32]]] = {
        "TMA, captions": [], "TMA, motions": [], "sentence encoder": []
    }  # fmt: skip
    for part in truths:
        captions = [t.caption for t in part]
        readers["TMA, captions"].append(tma.embed_captions(captions, cache).numpy())
        readers["TMA, motions"].append(embed_motions(tma, [t.features for t in part]).numpy())
        readers["sentence encoder"].append(np.asarray(cache.sentence(captions)))
    table = Table("read right", *(f"{name}: {kind}" for name in readers for kind in ("held out", "other")))
    for attribute in ATTRIBUTES:
        cells = [
            share
            for one, other in readers.values()
            for share in shares((truths[0], one), (truths[1], other), attribute, hold_out)
        ]
        table.add_row(attribute, *("" if np.isnan(cell) else f"{100 * cell:.0f} %" for cell in cells))
    Console().print(table)


if __name__ == "__main__":
    main()
