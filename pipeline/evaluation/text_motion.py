"""What a judge's latents say of motions that were made for captions: retrieval, distribution, variety.

Definitions and whose they are: docs/evaluation.md. Legend: n clips, Z latent width.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from motionloom.models.metrics.dance_choice import accuracy_among
from motionloom.models.metrics.diversity import diversity, multimodality
from motionloom.models.metrics.frechet import fid
from motionloom.models.metrics.retrieval import matching_score, r_precision
from motionloom.pipeline.evaluation.figures import Interval, chance, retrieval_figures

PAIRS = 10
"""Pairs of samples of one caption that MModality compares at most (4.1.2)."""


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


def retrieval(
    latents: Latents, words: Sequence[str], *, size: int, among: int, repeats: int, seed: int
) -> dict[str, Any]:
    """Recall among `size` and the matching score, of real and of generated motion.

    Clips are those drawn, as in the paper, so two of a batch may have one caption; the same of clips with
    different captions alone stands beside it.

    Args:
        latents: Of the clips.
        words: Their captions.
        size: Candidates of the recall.
        among: Candidates of UDE's accuracy (Table 1).
        repeats: Draws of batches.
        seed: Of the draws.
    """
    text, real, made = latents.text, latents.real, latents.made
    # A caption that says the same as the own one is no wrong answer.
    same = torch.tensor([[one == other for other in words] for one in words])
    among = min(among, 1 + int((~same).sum(1).min()))
    first = sorted({caption: row for row, caption in reversed(list(enumerate(words)))}.values())
    out = {"among": among, **_recalls(text, real, made, size, repeats, seed)}
    if 1 < len(first) < len(words):
        out["different_captions"] = _recalls(
            text[first], real[first], [m[first] for m in made], size, repeats, seed
        )
    if among > 1:
        for name, motions in (("real", [real]), ("generated", made)):
            rows = [accuracy_among(m, text, candidates=among, same=same, seed=seed) for m in motions]
            out[name] |= {key: Interval.of([row[key] for row in rows]) for key in rows[0]}
    return out


def matching(latents: Latents, *, size: int, repeats: int, seed: int) -> dict[str, Any]:
    """R-Precision top-1, 2 and 3 among `size` and the Matching score as Guo et al. define them: Euclidean
    distances of the latents as they are, in batches of clips as they are drawn.

    Of real motion, of generated one, and of the mean pose.

    Args:
        latents: Of the clips.
        size: Captions and motions of a batch.
        repeats: Draws of batches for what is there once; each repeat of generation has one.
        seed: Of the draws.
    """
    text, size = latents.text, min(size, len(latents.text))

    def row(motions: Sequence[Tensor]) -> dict[str, Interval]:
        found: dict[str, list[float]] = {}
        for number, motion in enumerate(motions):
            precision = r_precision(text, motion, batch=size, seed=seed + number).tolist()
            score = matching_score(text, motion, batch=size, seed=seed + number)
            once = {f"top-{k}": share for k, share in enumerate(precision, start=1)}
            for name, value in {**once, "matching_score": float(score)}.items():
                found.setdefault(name, []).append(value)
        return {name: Interval.of(values) for name, values in found.items()}

    draws = max(repeats, 5)
    return {
        "clips": len(text),
        "size": size,
        "chance": {f"top-{k}": min(1.0, chance(k, size)) for k in (1, 2, 3)},
        "real": row([latents.real] * draws),
        "generated": row(latents.made),
        "mean_pose": row([latents.still] * draws),
    }


def distribution(latents: Latents, *, seed: int) -> dict[str, Any]:
    """FID to the recorded motions, of the latents and of latents of length 1, Diversity and MModality.

    A FID means nothing without the number of clips and what other recorded motion gets at that number: as
    many training clips stand beside the generated ones, and the mean pose.
    """
    real, count = latents.real, len(latents.real)
    if count < 2:
        return {"clips": count, "rows": {}}

    def row(motions: Sequence[Tensor]) -> dict[str, Interval]:
        return {
            "fid": Interval.of([float(fid(real, m)) for m in motions]),
            "fid_unit": Interval.of([float(fid(_unit(real), _unit(m))) for m in motions]),
            "diversity": Interval.of([float(diversity(m, seed=seed)) for m in motions]),
        }

    rows = {
        "recorded": {"diversity": Interval(float(diversity(real, seed=seed)), 0.0)},
        "training": row([latents.others]) if len(latents.others) > 1 else {},
        "generated": row(latents.made),
        "mean_pose": row([latents.still]),
    }
    if len(latents.made) > 1:
        several = torch.stack(list(latents.made), dim=1)
        value = multimodality(several, pairs=min(PAIRS, several.shape[1]), seed=seed)
        rows["generated"]["multimodality"] = Interval(float(value), 0.0)
    return {"clips": count, "training_clips": len(latents.others), "rows": rows}


def reconstructed(
    real: Tensor, made: Tensor, others: Tensor, text: Tensor | None, *, size: int, repeats: int, seed: int
) -> dict[str, Any]:
    """FID of reconstructed motions to the recorded ones, beside as many training clips' (Tables 2 and 6).

    Args:
        real: Latents [n, Z] of the recorded clips.
        made: Of the same clips through a tokenizer.
        others: Of training clips, [m, Z].
        text: Of their captions, for R-Precision (Table 2); None where some have none.
        size: Captions and motions of a batch of R-Precision.
        repeats: Draws of batches.
        seed: Of the draws.
    """
    out: dict[str, Any] = {"clips": len(real)}
    if len(real) > 1:
        out["fid"] = float(fid(real, made))
        out |= {"training_fid": float(fid(real, others))} if len(others) > 1 else {}
    if text is not None:
        size = min(size, len(text))
        draws = range(seed, seed + max(repeats, 5))
        for name, motions in (("", made), ("recorded_", real)):
            rows = [r_precision(text, motions, batch=size, seed=draw).tolist() for draw in draws]
            columns = zip(*rows, strict=True)
            out |= {f"{name}top-{k}": Interval.of(values) for k, values in enumerate(columns, start=1)}
        out |= {f"chance_top-{k}": min(1.0, chance(k, size)) for k in (1, 2, 3)}
        out["size"] = size
    return out


def _recalls(
    text: Tensor, real: Tensor, made: Sequence[Tensor], size: int, repeats: int, seed: int
) -> dict[str, Any]:
    size = min(size, len(text))
    known = retrieval_figures(text, real, size=size, repeats=max(repeats, 5), seed=seed)
    rows: dict[str, list[float]] = {}
    for repeat, latent in enumerate(made):
        once = retrieval_figures(text, latent, size=size, repeats=1, seed=seed + repeat)
        for name, value in {**once, **_distances(text, latent)}.items():
            rows.setdefault(name, []).append(value.mean)
    return {
        "clips": len(text),
        "size": size,
        "chance": {f"r{k}": chance(k, size) for k in (1, 2, 3)},
        "real": {**known, **_distances(text, real)},
        "generated": {name: Interval.of(values) for name, values in rows.items()},
    }


def _distances(text: Tensor, motion: Tensor) -> dict[str, Interval]:
    """Mean distance of each text's latent from its motion's, both of length 1, and as they are."""
    unit = matching_score(_unit(text), _unit(motion))
    plain_distance = matching_score(text, motion)
    return {
        "matching_score": Interval(float(unit), 0.0),
        "latent_distance": Interval(float(plain_distance), 0.0),
    }


def caption_distances(text: Tensor, motion: Tensor) -> Tensor:
    """Of each text's latent [n, Z] from its motion's, both of length 1: [n], 0 to 2."""
    out: Tensor = torch.linalg.vector_norm(_unit(text) - _unit(motion), dim=-1)
    return out


def _unit(x: Tensor) -> Tensor:
    return normalize(x.double(), dim=-1)
