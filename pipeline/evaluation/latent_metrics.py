"""What a judge's latents say of motions that were made for captions: retrieval, distribution, variety.

A metric is a function of `LatentRow`, called for what was generated and for every answer that needs no
model, and a line in a list here. Definitions and whose they are: docs/evaluation.md.

Legend: n clips, Z latent width.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn.functional import normalize

from motionloom.models.metrics.distributions import diversity, fid, multimodality
from motionloom.models.metrics.retrieval import accuracy_among, matching_score, r_precision, recall
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
"""Draws of batches, at least, for motions that are there once."""

Values = dict[str, float]


@dataclass(frozen=True)
class Latents:
    """Row by row of the same n clips, [n, Z] each, but for `others`."""

    text: Tensor
    """Of their captions."""
    real: Tensor
    """Of the recorded motions."""
    made: Sequence[Tensor]
    """Of the motions made for their captions, once a repeat."""
    others: Tensor
    """Of training clips, [m, Z]."""
    still: Tensor
    """Of the mean pose for as long as each clip."""
    nearest: Mapping[str, Tensor] = field(default_factory=dict)
    """Row -> of the training clips found for their captions."""


@dataclass(frozen=True)
class LatentRow:
    """Latents [n, Z] of captions, of recorded motions and of those that are measured."""

    text: Tensor
    real: Tensor
    motion: Tensor
    seed: int
    """Of the draws of batches and pairs."""
    size: int
    """Candidates of R-Precision."""


@dataclass(frozen=True)
class LatentMetric:
    """A function of a row of latents, and its columns, whose names get the judge's in front."""

    measure: Callable[[LatentRow], Values]
    columns: tuple[Metric, ...]


def recalls(row: LatentRow) -> Values:
    """TMA-R-Precision both ways, by cosine (protocols C and D)."""
    found = recall(row.text, row.motion, batch=row.size, recalls=(1, 2, 3), seed=row.seed * 1000)
    return {name.replace("/R@", "_r"): value for name, value in found.items() if "/R@" in name}


def caption_distance(row: LatentRow) -> Values:
    """Mean distance of each caption's latent from its motion's, both of length 1, and as they are."""
    unit = matching_score(_unit(row.text), _unit(row.motion))
    return {"matching_score": float(unit), "latent_distance": float(matching_score(row.text, row.motion))}


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
        "fid_unit": float(fid(_unit(row.real), _unit(row.motion))),
        "diversity": float(diversity(row.motion, seed=row.seed)),
    }


TMA_METRICS = (
    LatentMetric(
        recalls,
        (
            *(Metric(f"t2m_r{k}", f"text to motion R@{k}", "higher") for k in (1, 2, 3)),
            *(Metric(f"m2t_r{k}", f"motion to text R@{k}", "higher") for k in (1, 2, 3)),
        ),
    ),
    LatentMetric(
        caption_distance,
        (
            Metric("matching_score", "TMA-Matching score", "lower"),
            Metric("latent_distance", "distance of the latents", "lower"),
        ),
    ),
)
"""Of text-motion alignment by TMA."""
EVALUATOR_METRICS = (
    LatentMetric(
        guo_precision,
        (
            *(Metric(f"top-{k}", f"R-Precision top-{k}", "higher") for k in (1, 2, 3)),
            Metric("matching_score", "Matching score", "lower"),
        ),
    ),
)
"""The same by an evaluator, as Guo et al. define it."""
SPREAD_METRICS = (
    LatentMetric(
        spread,
        (
            Metric("fid", "FID", "lower"),
            Metric("fid_unit", "FID, length 1", "lower"),
            Metric("diversity", "Diversity"),
        ),
    ),
)
"""Of how motions spread, by any judge."""
_VARIETY = Metric("multimodality", "MModality")
_CHOICE = tuple(Metric(f"tma.top-{k}", f"top-{k}", "higher") for k in (1, 5))


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
    if role != "tma":
        title = f"R-Precision by {whose} (higher is better; the score: lower)"
        out = _precision(role, title, EVALUATOR_METRICS, latents, facts, size, seed)
    else:
        # Clips are those drawn, as in the paper, so two of a batch may have one caption.
        title = "TMA-R-Precision (higher is better; the score: lower)"
        out = _precision(role, title, TMA_METRICS, latents, facts, size, seed)
        first = sorted({caption: row for row, caption in reversed(list(enumerate(words)))}.values())
        if 1 < len(first) < len(words):
            some = _at(latents, first)
            size = min(size, len(first))
            facts = {**protocol, "clips": len(first), "candidates": size, "captions": "different"}
            title = "TMA-R-Precision among different captions"
            out += _precision("tma.different", title, TMA_METRICS, some, facts, size, seed)
        out += _choice(latents, words, protocol, among, seed)
    return out + _spread(role, f"{whose[:1].upper()}{whose[1:]}'s latents", latents, protocol, seed)


def _precision(
    role: str,
    title: str,
    metrics: Sequence[LatentMetric],
    latents: Latents,
    protocol: Protocol,
    size: int,
    seed: int,
) -> list[Figure]:
    """Text and motion compared: of generated motion a draw of batches a repeat, of the others several."""
    draws = max(len(latents.made), DRAWS)
    once = {RECORDED: latents.real, STILL: latents.still, **latents.nearest}
    measured = {MODEL: latents.made} | {row: [found] * draws for row, found in once.items()}
    rows = _measured(role, metrics, latents, measured, seed, size, decodings_of(protocol))
    guess = {key: min(1.0, int(key[-1]) / size) for key in ("t2m_r1", "t2m_r2", "t2m_r3")}
    guess |= {key.replace("t2m", "m2t"): share for key, share in guess.items()}
    guess |= {f"top-{k}": min(1.0, k / size) for k in (1, 2, 3)}
    rows[CHANCE] = _named(role, plain(guess))
    return group_figures(title, _columns(role, metrics), rows, protocol)


def _choice(
    latents: Latents, words: Sequence[str], protocol: Protocol, among: int, seed: int
) -> list[Figure]:
    """UDE's accuracy: is a motion's own caption the nearest of `among`?"""
    # A caption that says the same as the own one is no wrong answer.
    same = torch.tensor([[one == other for other in words] for one in words])
    among = min(among, 1 + int((~same).sum(1).min()))
    if among < 2:
        return []
    rows = {}
    once = {RECORDED: latents.real, **latents.nearest}
    for row, motions in {MODEL: latents.made, **{row: [found] for row, found in once.items()}}.items():
        each = [accuracy_among(m, latents.text, candidates=among, same=same, seed=seed) for m in motions]
        rows[row] = _named("tma", set_estimates(each, decodings_of(protocol) if row == MODEL else 1))
    rows[CHANCE] = _named("tma", plain({f"top-{k}": min(1.0, k / among) for k in (1, 5)}))
    return group_figures("Own caption the nearest, by TMA", _CHOICE, rows, {**protocol, "candidates": among})


def _spread(role: str, title: str, latents: Latents, protocol: Protocol, seed: int) -> list[Figure]:
    """Distance to the recorded motions and variety, beside as many training clips and the mean pose."""
    measured = {
        MODEL: latents.made, TRAINING: [latents.others], STILL: [latents.still], RECORDED: [latents.real]
    }  # fmt: skip
    measured |= {row: [found] for row, found in latents.nearest.items()}
    nested = decodings_of(protocol)
    rows = _measured(role, SPREAD_METRICS, latents, measured, seed, 0, nested, draw=False)
    for name in ("fid", "fid_unit"):
        rows[RECORDED].pop(f"{role}.{name}", None)  # to themselves
    if len(latents.made) > 1 and len(latents.real) > 1:
        several = torch.stack(list(latents.made), dim=1)
        value = multimodality(several, pairs=PAIRS, seed=seed)
        rows[MODEL][f"{role}.multimodality"] = Estimate(float(value))
    metrics = (*SPREAD_METRICS, LatentMetric(lambda row: {}, (_VARIETY,)))
    facts = {**protocol, "training_clips": len(latents.others)}
    width = latents.real.shape[1]
    few = f"{len(latents.real)} motions for {width} columns, too few to be trusted"
    notes = {f"{role}.{name}": few for name in ("fid", "fid_unit") if len(latents.real) <= width}
    return group_figures(
        f"{title}: distance to recorded motion and variety", _columns(role, metrics), rows, facts, notes
    )


def reconstructed_figures(
    role: str,
    whose: str,
    real: Tensor,
    made: Tensor,
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
    prefix, facts = f"reconstruction.{role}", {**protocol, "training_clips": len(others)}
    rows: dict[str, dict[str, Estimate]] = {MODEL: {}}
    if len(real) > 1:
        rows[MODEL] |= plain({"fid": float(fid(real, made))})
        rows[TRAINING] = plain({"fid": float(fid(real, others))}) if len(others) > 1 else {}
    if text is not None:
        size = min(size, len(text))
        facts["candidates"] = size
        for row, motions in ((MODEL, made), (RECORDED, real)):
            draws = range(seed, seed + max(repeats, DRAWS))
            each = [guo_precision(LatentRow(text, real, motions, draw, size)) for draw in draws]
            rows[row] = rows.get(row, {}) | set_estimates(each)
        rows[CHANCE] = plain({f"top-{k}": min(1.0, k / size) for k in (1, 2, 3)})
    tops = (Metric(f"{prefix}.top-{k}", f"R-Precision top-{k}", "higher") for k in (1, 2, 3))
    columns = (Metric(f"{prefix}.fid", "FID", "lower"), *tops)
    named = {row: _named(prefix, found) for row, found in rows.items()}
    return group_figures(f"Reconstructed motion by {whose}'s latents", columns, named, facts)


def _measured(
    role: str,
    metrics: Sequence[LatentMetric],
    latents: Latents,
    rows: dict[str, Sequence[Tensor]],
    seed: int,
    size: int,
    nested: int,
    *,
    draw: bool = True,
) -> dict[str, dict[str, Estimate]]:
    """Row -> estimates by name, of motions that are there once or more often."""
    out = {}
    for name, motions in rows.items():
        each = []
        for number, motion in enumerate(motions):
            row = LatentRow(latents.text, latents.real, motion, seed + (number if draw else 0), size)
            each.append({key: value for metric in metrics for key, value in metric.measure(row).items()})
        out[name] = _named(role, set_estimates(each, nested if name == MODEL else 1))
    return out


def _columns(role: str, metrics: Sequence[LatentMetric]) -> list[Metric]:
    return [
        Metric(f"{role}.{column.name}", column.title, column.better, column.unit)
        for metric in metrics
        for column in metric.columns
    ]


def _named(role: str, found: dict[str, Estimate]) -> dict[str, Estimate]:
    return {f"{role}.{name}": value for name, value in found.items()}


def _at(latents: Latents, rows: list[int]) -> Latents:
    """Of some of the clips."""
    made = [one[rows] for one in latents.made]
    nearest = {row: found[rows] for row, found in latents.nearest.items()}
    return Latents(latents.text[rows], latents.real[rows], made, latents.others, latents.still[rows], nearest)


def caption_distances(text: Tensor, motion: Tensor) -> Tensor:
    """Of each text's latent [n, Z] from its motion's, both of length 1: [n], 0 to 2."""
    out: Tensor = torch.linalg.vector_norm(_unit(text) - _unit(motion), dim=-1)
    return out


def _unit(x: Tensor) -> Tensor:
    return normalize(x.double(), dim=-1)
