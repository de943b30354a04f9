"""Metrics of motions in a judge's latent space: retrieval, distance of distributions, variety.

A metric is a function of `LatentRow`, called for generated motion and for every reference baseline, and its
columns here. Definitions and whose they are: docs/evaluation.md.

Legend: n clips, Z latent width.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from motionloom.models.metrics.distributions import diversity, fid, multimodality
from motionloom.models.metrics.retrieval import (
    accuracy_among,
    matching_score,
    other_texts,
    r_precision,
    recall,
)
from motionloom.pipeline.evaluation.estimate import plain, set_estimates
from motionloom.pipeline.evaluation.figures import (
    CHANCE,
    MODEL,
    RECORDED,
    STILL,
    TRAINING,
    Estimate,
    Figure,
    Metric,
    Protocol,
    decodings_of,
    group_figures,
)

GUO_BATCH = 32
"""Candidates of R-Precision in the papers' tables, by an evaluator as Guo et al. define it."""
PAIRS = 10
"""Pairs of samples of one caption that MModality compares at most (4.1.2)."""
DRAWS = 5
"""Draws of batches, at least, for motions that exist once **[ours]**."""

Values = dict[str, float]


@dataclass(frozen=True)
class LatentRow:
    """Latents [n, Z] of captions, of recorded motions and of the motions that are measured."""

    text: Tensor
    real: Tensor
    motion: Tensor
    seed: int
    """Seed of the draws of batches and pairs."""
    size: int = 0
    """Number of candidates of R-Precision."""


@dataclass(frozen=True)
class Latents:
    """Latents of n clips, [n, Z] each, but for `others`."""

    text: Tensor
    """Captions of the clips."""
    real: Tensor
    """Recorded motions of the clips."""
    made: Sequence[Tensor]
    """Motions generated for the captions, once a repeat."""
    others: Tensor
    """Training clips, [m, Z]."""
    still: Tensor
    """The mean pose, held as long as each clip."""
    nearest: Mapping[str, Tensor] = field(default_factory=dict)
    """Row of a table -> training clips retrieved for the captions."""

    def row(self, seed: int, size: int = 0) -> LatentRow:
        """The recorded motions, measured."""
        return LatentRow(self.text, self.real, self.real, seed, size)

    def of(self, clips: list[int]) -> Latents:
        """The latents of some of the clips."""
        made = [one[clips] for one in self.made]
        nearest = {row: one[clips] for row, one in self.nearest.items()}
        text = self.text[clips]
        real = self.real[clips]
        still = self.still[clips]
        return Latents(text, real, made, self.others, still, nearest)


def recalls(row: LatentRow) -> Values:
    """TMA-R-Precision both ways, by cosine (protocols C and D)."""
    values = recall(row.text, row.motion, batch=row.size, recalls=(1, 2, 3), seed=row.seed * 1000)
    return {name.replace("/R@", "_r"): value for name, value in values.items() if "/R@" in name}


def tma_alignment(row: LatentRow) -> Values:
    """`recalls`, and mean distances between captions and their motions, of unit length and as they are."""
    unit = matching_score(unit_length(row.text), unit_length(row.motion))
    plain_score = matching_score(row.text, row.motion)
    return recalls(row) | {"matching_score": float(unit), "latent_distance": float(plain_score)}


def guo_precision(row: LatentRow) -> Values:
    """R-Precision top-1, 2 and 3 and the Matching score as Guo et al. define them: Euclidean distances of the
    latents as they are, in batches of clips as they are drawn.
    """
    size = min(row.size, len(row.text))
    precision = r_precision(row.text, row.motion, batch=size, seed=row.seed).tolist()
    score = matching_score(row.text, row.motion, batch=size, seed=row.seed)
    return {f"top-{k}": share for k, share in enumerate(precision, start=1)} | {
        "matching_score": float(score)
    }


def spread(row: LatentRow) -> Values:
    """FID to the recorded motions, of the latents and of latents of length 1, and Diversity.

    A FID means nothing without the number of clips and what other recorded motion gets at that number.
    """
    if len(row.real) < 2 or len(row.motion) < 2:
        return {}
    return {
        "fid": float(fid(row.real, row.motion)),
        "fid_unit": float(fid(unit_length(row.real), unit_length(row.motion))),
        "diversity": float(diversity(row.motion, seed=row.seed)),
    }


_TOPS = tuple(Metric(f"top-{k}", f"R-Precision top-{k}", "higher") for k in (1, 2, 3))
TMA_COLUMNS = (
    *(Metric(f"t2m_r{k}", f"text to motion R@{k}", "higher") for k in (1, 2, 3)),
    *(Metric(f"m2t_r{k}", f"motion to text R@{k}", "higher") for k in (1, 2, 3)),
    Metric("matching_score", "TMA-Matching score", "lower"),
    Metric("latent_distance", "distance of the latents", "lower"),
)
"""Columns of `tma_alignment`; the judge stands before the names."""
EVALUATOR_COLUMNS = (*_TOPS, Metric("matching_score", "Matching score", "lower"))
"""Columns of `guo_precision`."""
SPREAD_COLUMNS = (
    Metric("fid", "FID", "lower"),
    Metric("fid_unit", "FID, length 1", "lower"),
    Metric("diversity", "Diversity"),
    Metric("multimodality", "MModality"),
)
"""Columns of `spread`, and the variety of motions for one caption."""


def judged_figures(
    role: str,
    whose: str,
    latents: Latents,
    words: Sequence[str],
    protocol: Protocol,
    *,
    size: int,
    among: int,
    seed: int,
) -> list[Figure]:
    """All figures by one judge.

    Args:
        role: Of the judge: tma, evaluator or face_evaluator; begins the names.
        whose: The judge's name, for people.
        latents: Of the clips.
        words: Their captions.
        protocol: How the motions were made, and the judge's checksum.
        size: Candidates of R-Precision.
        among: Candidates of UDE's accuracy (Table 1), by TMA.
        seed: Of the draws.
    """
    size = min(size, len(words))
    facts = {**protocol, "candidates": size}
    # Clips are those drawn, as in the paper, so two of a batch may have one caption.
    title = "TMA-R-Precision" if role == "tma" else f"R-Precision by {whose}"
    out = _precision(role, f"{title} (higher is better; the score: lower)", latents, facts, size, seed)
    if role == "tma":
        first = sorted({caption: row for row, caption in reversed(list(enumerate(words)))}.values())
        if 1 < len(first) < len(words):
            some = latents.of(first)
            size = min(size, len(first))
            facts = {**protocol, "clips": len(first), "candidates": size, "captions": "different"}
            title = "TMA-R-Precision among different captions"
            out += _precision("tma.different", title, some, facts, size, seed)
        out += _choice(latents, words, protocol, among, seed)
    return out + _spread(role, f"{whose[:1].upper()}{whose[1:]}'s latents", latents, protocol, seed)


def _precision(
    role: str, title: str, latents: Latents, protocol: Protocol, size: int, seed: int
) -> list[Figure]:
    """Figures of captions and motions compared, beside recorded motion, the mean pose and chance."""
    tma = role.startswith("tma")
    measure, columns = (tma_alignment, TMA_COLUMNS) if tma else (guo_precision, EVALUATOR_COLUMNS)
    # One draw of batches for each repeat of generated motion; of what exists once, several draws.
    draws = max(len(latents.made), DRAWS)
    once = {RECORDED: latents.real, STILL: latents.still, **latents.nearest}
    motions = {MODEL: latents.made} | {row: [motion] * draws for row, motion in once.items()}
    rows = _measured(measure, latents.row(seed, size), motions, decodings_of(protocol))
    return group_figures(title, columns, rows | {CHANCE: _chance(size)}, protocol, prefix=f"{role}.")


def _chance(size: int) -> dict[str, Estimate]:
    """Recall by guessing among `size` candidates, by the names of `recalls` and `guo_precision`."""
    names = ("t2m_r", "m2t_r", "top-")
    return plain({f"{name}{k}": min(1.0, k / size) for name in names for k in (1, 2, 3)})


def _choice(
    latents: Latents, words: Sequence[str], protocol: Protocol, among: int, seed: int
) -> list[Figure]:
    """Figures of UDE's accuracy (Table 1): whether a motion's own caption is the nearest of `among`."""
    # A caption that says the same as the own one is no wrong answer.
    numbers: dict[str, int] = {}
    meaning = torch.tensor([numbers.setdefault(caption, len(numbers)) for caption in words])
    among = min(among, 1 + len(words) - int(meaning.bincount().max()))
    if among < 2:
        return []
    others = other_texts(meaning, among - 1, seed)

    def accuracy(row: LatentRow) -> Values:
        return accuracy_among(row.motion, row.text, others)

    once = {RECORDED: latents.real, **latents.nearest}
    motions = {MODEL: latents.made} | {row: [motion] for row, motion in once.items()}
    rows = _measured(accuracy, latents.row(seed), motions, decodings_of(protocol), draw=False)
    rows[CHANCE] = plain({f"top-{k}": min(1.0, k / among) for k in (1, 5)})
    columns = [Metric(f"top-{k}", f"top-{k}", "higher") for k in (1, 5)]
    facts = {**protocol, "candidates": among}
    return group_figures("Own caption the nearest, by TMA", columns, rows, facts, prefix="tma.")


def _spread(role: str, title: str, latents: Latents, protocol: Protocol, seed: int) -> list[Figure]:
    """FID and variety, also of as many training clips and of the mean pose."""
    motions = {
        MODEL: latents.made, TRAINING: [latents.others], STILL: [latents.still], RECORDED: [latents.real]
    }  # fmt: skip
    motions |= {row: [motion] for row, motion in latents.nearest.items()}
    rows = _measured(spread, latents.row(seed), motions, decodings_of(protocol), draw=False)
    for name in ("fid", "fid_unit"):
        rows[RECORDED].pop(name, None)  # the distance of recorded motion to itself says nothing
    if len(latents.made) > 1 and len(latents.real) > 1:
        several = torch.stack(list(latents.made), dim=1)
        rows[MODEL]["multimodality"] = Estimate(float(multimodality(several, pairs=PAIRS, seed=seed)))
    facts = {**protocol, "training_clips": len(latents.others)}
    # A covariance of so few rows does not have full rank.
    width = latents.real.shape[1]
    few = f"{len(latents.real)} motions for {width} columns, too few to be trusted"
    notes = {name: few for name in ("fid", "fid_unit") if len(latents.real) <= width}
    title = f"{title}: distance to recorded motion and variety"
    return group_figures(title, SPREAD_COLUMNS, rows, facts, notes, prefix=f"{role}.")


def reconstructed_figures(
    role: str,
    whose: str,
    real: Tensor,
    rebuilt: Tensor,
    others: Tensor,
    text: Tensor | None,
    protocol: Protocol,
    *,
    size: int,
    repeats: int,
    seed: int,
) -> list[Figure]:
    """FID of reconstructed motions to the recorded ones, beside as many training clips' (Tables 2 and 6).

    Args:
        role: Of the judge.
        whose: The judge's name, for people.
        real: Latents [n, Z] of the recorded clips.
        made: Of the same clips through a tokenizer.
        others: Of training clips, [m, Z].
        text: Of their captions, for R-Precision (Table 2); None where some have none.
        protocol: Of the clips, and the judge's checksum.
        size: Captions and motions of a batch of R-Precision.
        repeats: Draws of batches.
        seed: Of the draws.
    """
    facts = {**protocol, "training_clips": len(others)}
    base = LatentRow(real if text is None else text, real, rebuilt, seed, min(size, len(real)))
    # FID of as many training clips says what a draw of clips alone gives.
    rows = _measured(spread, base, {MODEL: [rebuilt], TRAINING: [others]})
    if text is not None:
        facts["candidates"] = base.size
        motions = {
            row: [motion] * max(repeats, DRAWS) for row, motion in ((MODEL, rebuilt), (RECORDED, real))
        }
        for row, estimates in _measured(guo_precision, base, motions).items():
            rows[row] = rows.get(row, {}) | estimates
        rows[CHANCE] = _chance(base.size)
    title = f"Reconstructed motion by {whose}'s latents"
    columns = (SPREAD_COLUMNS[0], *_TOPS)
    return group_figures(title, columns, rows, facts, prefix=f"reconstruction.{role}.")


def _measured(
    measure: Callable[[LatentRow], Values],
    base: LatentRow,
    rows: Mapping[str, Sequence[Tensor]],
    nested: int = 1,
    *,
    draw: bool = True,
) -> dict[str, dict[str, Estimate]]:
    """Row -> estimates by name; the motions [n, Z] of a row take the place of `base.motion`, one a repeat.

    With `draw` every repeat draws batches of its own; of the model, `nested` repeats are of the same tokens.
    """
    out = {}
    for name, motions in rows.items():
        repeats = [
            measure(replace(base, motion=motion, seed=base.seed + number * draw))
            for number, motion in enumerate(motions)
        ]
        out[name] = set_estimates(repeats, nested if name == MODEL else 1)
    return out


def unit_length(x: Tensor) -> Tensor:
    """Latents [..., Z] in float64, scaled to length 1."""
    return normalize(x.double(), dim=-1)
