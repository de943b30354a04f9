"""What is taken for what: the caption that TMA finds nearest to a motion, against its own caption **[ours]**.

Each motion is compared with every different caption of the evaluated clips, by the cosine of TMA's latents.
Of synthetic clips their actions are compared, and, without any network, the action that the joints show; of
others the captions themselves. Generated motions are those of the first repeat.

An entry of `confusions` is a matrix: `counts` [rows, columns] of clips, `of` real or generated motions, `by`
retrieval or joints, `about` "action" or "caption". The last column may be `ANOTHER`, which is no row.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from motionloom.datasets.synth.measure import measure
from motionloom.pipeline.evaluation.latent_metrics import Latents
from motionloom.pipeline.evaluation.truth import Truth

CAPTIONS = 8
"""Captions in a matrix, so that it can be read."""
ANOTHER = "(another)"
Pair = tuple[str, str]


def retrieval_confusions(latents: Latents, truths: Sequence[Truth]) -> list[dict[str, Any]]:
    """Matrices of the rank-1 captions of the generated and of the recorded motions."""
    words = [truth.caption for truth in truths]
    out: list[dict[str, Any]] = []
    for of, motion in (("generated", latents.made[0]), ("real", latents.real)):
        taken = nearest_captions(latents.text, motion, words)
        facts = {"of": of, "by": "retrieval", "captions": len(set(words))}
        actions = [(truth.truth or {}).get("action") for truth in truths]
        if all(actions):
            pairs = [(str(own), str(actions[k])) for own, k in zip(actions, taken, strict=True)]
            out.append(_matrix(pairs, {**facts, "about": "action"}))
        else:
            pairs = [(own, words[k]) for own, k in zip(words, taken, strict=True)]
            out += _captions(pairs, facts)
    return out


def measured_confusions(
    truths: Sequence[Truth], motions: Sequence[NDArray[Any]], fps: float
) -> list[dict[str, Any]]:
    """The action that is asked for against the one that generated joints [T, N, 3] show; synthetic clips."""
    pairs = [
        (str(truth.truth["action"]), measure(joints, fps).action)
        for truth, joints in zip(truths, motions, strict=True)
        if truth.truth and "action" in truth.truth
    ]
    return [_matrix(pairs, {"of": "generated", "by": "joints", "about": "action"})] if pairs else []


def nearest_captions(text: Tensor, motion: Tensor, words: Sequence[str]) -> list[int]:
    """For each motion [n, Z] the clip whose caption [n, Z] is nearest; of equal captions the first."""
    first = sorted({caption: row for row, caption in reversed(list(enumerate(words)))}.values())
    near = normalize(motion.double(), dim=-1) @ normalize(text[first].double(), dim=-1).T
    return torch.tensor(first)[near.argmax(1).cpu()].tolist()  # type: ignore[no-any-return]


def _captions(pairs: Sequence[Pair], facts: dict[str, Any]) -> list[dict[str, Any]]:
    """The matrix of the captions that are confused most often; none where no motion is taken for another."""
    wrong = Counter(pair for pair in pairs if pair[0] != pair[1])
    chosen: list[str] = []
    for pair, _ in sorted(wrong.items(), key=lambda item: (-item[1], item[0])):
        new = [caption for caption in pair if caption not in chosen]
        if len(chosen) + len(new) <= CAPTIONS:
            chosen += new
    if not chosen:
        return []
    kept = [(own, taken if taken in chosen else ANOTHER) for own, taken in pairs if own in chosen]
    return [_matrix(kept, {**facts, "about": "caption"}, sorted(chosen))]


def _matrix(
    pairs: Sequence[Pair], facts: dict[str, Any], rows: Sequence[str] | None = None
) -> dict[str, Any]:
    """Counts of (own, taken): a row for each own, the same in the columns and then what else is taken."""
    counts = Counter(pairs)
    names = sorted({own for own, _ in pairs}) if rows is None else list(rows)
    columns = [*names, *sorted({taken for _, taken in pairs} - set(names))]
    return {
        **facts,
        "rows": names,
        "columns": columns,
        "counts": [[counts[own, taken] for taken in columns] for own in names],
    }
