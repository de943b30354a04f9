"""A trained evaluator as later stages use it, what reads its captions, and motions embedded by any judge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import PRESENT_ALL
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.models.evaluator.network import PART, Evaluator
from motionloom.pipeline.store.networks import LoadedTma, device_of
from motionloom.pipeline.store.text import TextSource

_BATCH = 256


class Words(NamedTuple):
    """Captions as a text encoder takes them."""

    features: Tensor
    """Token features [n, S, E]."""
    mask: Tensor
    """Real tokens, bool [n, S]."""
    classes: Tensor | None = None
    """One-hot [n, S, G], of words that come with classes."""


class CaptionReader(Protocol):
    """Turns captions into the words that an evaluator was trained on."""

    def read(self, captions: Sequence[str], tokens: Sequence[Sequence[str]]) -> Words:
        """`tokens`: the `word/POS` tags of each caption, empty where there are none."""
        ...


@dataclass(frozen=True)
class StageWords:
    """Token features of a run's text stage: of the one that the evaluator was trained with, and no other."""

    text: TextSource
    encoder: str
    """Name of the encoder that it was trained with."""
    where: str
    """The evaluator's file, for messages."""

    def read(self, captions: Sequence[str], tokens: Sequence[Sequence[str]]) -> Words:
        cache = self.text.cache
        if cache.encoder != self.encoder:
            raise UserError(
                f"{self.where}: this evaluator was trained on captions as {self.encoder} encodes them and is "
                f"given those of {cache.encoder}; give it its own text stage, or train it again"
            )
        unknown = [captions[i] for i in np.flatnonzero(cache.find(captions) < 0).tolist()]
        if unknown:
            raise UserError(
                f"{cache.folder}: {len(unknown)} of the {len(captions)} captions to be judged are not here, "
                f"such as '{unknown[0][:80]}'; train the evaluator on the data that it shall judge"
            )
        features, mask = cache.tokens(captions)
        return Words(torch.as_tensor(features), torch.as_tensor(mask))


@dataclass(frozen=True)
class LoadedEvaluator:
    """An evaluator with what it reads by. Its methods take tensors of any device."""

    net: Evaluator
    layout: MotionLayout
    stats: FeatureStats
    """Mean and deviation of its motion."""
    words: CaptionReader
    part: Part = PART

    @property
    def max_frames(self) -> int:
        return self.net.max_frames

    def require_layout(self, layout: MotionLayout, stage: str) -> None:
        """Refuse to judge motions of another layout than it was trained on; `stage` is its name."""
        if layout != self.layout:
            raise UserError(
                f"evaluator '{stage}' judges {_said(self.layout)}, and the data are {_said(layout)}; train "
                f"one on these data, or leave it out (inputs: {{evaluator: null}})"
            )

    @torch.no_grad()
    def embed_motion(self, motion: Tensor, length: Tensor, present: Tensor | None = None) -> Tensor:
        """Latents [B, Z] of features [B, T, D] of `part`, length int64 [B], `present` bool [B, D] or None."""
        device = device_of(self.net)
        near = None if present is None else present.to(device)
        return self.net.encode_motion(motion.to(device), length.to(device), near)

    @torch.no_grad()
    def embed_captions(self, captions: Sequence[str], tokens: Sequence[Sequence[str]]) -> Tensor:
        """Latents [n, Z] of captions, and their `word/POS` tags as in `CaptionReader`, on the CPU."""
        device = device_of(self.net)
        out = []
        for start in range(0, len(captions), _BATCH):
            rows = slice(start, start + _BATCH)
            words = self.words.read(captions[rows], tokens[rows])
            near = [None if value is None else value.to(device) for value in words]
            out.append(self.net.encode_text(*near).cpu())  # type: ignore[arg-type]
        return torch.cat(out)


def _said(layout: MotionLayout) -> str:
    return f"{layout.name} at {layout.fps:g} fps (family {layout.family})"


def embed_motions(
    judge: LoadedTma | LoadedEvaluator,
    motions: Sequence[NDArray[np.float32]],
    present: Sequence[int] | None = None,
    batch: int = 64,
) -> Tensor:
    """Latents [n, Z] of body-hand features, by TMA or an evaluator; longer motions are cut at its length.

    `present` [n]: what each holds (all when None); the rest is 0, the mean, as in training.
    """
    columns = judge.layout.part(judge.part)
    mean = judge.stats.mean[columns]
    std = judge.stats.std[columns]
    order = np.argsort([len(m) for m in motions], kind="stable")
    masks = judge.layout.present_columns[:, columns][
        [PRESENT_ALL] * len(motions) if present is None else present
    ]
    out: dict[int, Tensor] = {}
    for start in range(0, len(order), batch):
        rows = order[start : start + batch].tolist()
        cut = [(motions[i][: judge.max_frames] - mean) / std for i in rows]
        length = torch.tensor([len(m) for m in cut])
        motion = torch.zeros(len(cut), int(length.max()), len(columns))
        for row, values in enumerate(cut):
            motion[row, : len(values)] = torch.from_numpy(values.astype(np.float32))
        near = torch.from_numpy(masks[rows])
        for i, latent in zip(rows, judge.embed_motion(motion, length, near).cpu(), strict=True):
            out[i] = latent
    return torch.stack([out[i] for i in range(len(motions))])
