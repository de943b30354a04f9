"""From prompts, as people give them, to the `Conditions` that networks take."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from motionloom.datasets.conditions import Condition, Conditions
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.store.text import TextSource


class PromptEncoder:
    """Encodes prompts for one generator, with the text encoder that it was trained with."""

    def __init__(self, text: TextSource | None, device: torch.device) -> None:
        self.text, self.device = text, device

    def encode(
        self, prompts: Sequence[Prompt], words: Sequence[str], modalities: frozenset[str], fps: float
    ) -> Conditions:
        """The conditions of `modalities`, those that no prompt has left out.

        `words` are the prompts' texts, about the body or the face; an empty one is no text.
        """
        out: dict[str, Condition] = {}
        if "text" in modalities and any(text.strip() for text in words):
            out["text"] = self._texts(words)
        if "audio" in modalities and any(prompt.sound for prompt in prompts):
            out["audio"] = self._sounds(prompts, fps)
        return out

    def _texts(self, words: Sequence[str]) -> Condition:
        if self.text is None:
            raise UserError("this model has no text encoder; drive it by sound")
        encoded = self.text.encoder.encode(list(words))
        features, mask = torch.as_tensor(encoded.tokens), torch.as_tensor(encoded.mask)
        pooled = torch.as_tensor(encoded.sentence)
        there = torch.tensor([bool(text.strip()) for text in words])
        if not there.all():
            mask = mask & there[:, None]
            features, pooled = features * mask[..., None], pooled * there[:, None]
        return Condition(*(value.to(self.device) for value in (features, mask, pooled)))

    def _sounds(self, prompts: Sequence[Prompt], fps: float) -> Condition:
        from motionloom.datasets.audio.lineup import motion_frame_features

        rows: list[Tensor | None] = []
        for prompt in prompts:
            sound = prompt.sound
            if sound is None:
                rows.append(None)
                continue
            frames = max(1, round(sound.seconds * fps))
            found = motion_frame_features(sound.samples, sound.rate, fps, frames)
            rows.append(torch.from_numpy(np.ascontiguousarray(found)))
        return _padded(rows, lambda value: value.to(self.device))


def _padded(rows: Sequence[Tensor | None], move: Callable[[Tensor], Tensor]) -> Condition:
    """Rows [L_i, E], or None, as one condition."""
    width = next(row.shape[1] for row in rows if row is not None)
    longest = max(len(row) for row in rows if row is not None)
    features, mask = torch.zeros(len(rows), longest, width), torch.zeros(len(rows), longest, dtype=torch.bool)
    for k, row in enumerate(rows):
        if row is not None:
            features[k, : len(row)], mask[k, : len(row)] = row, True
    return Condition(move(features), move(mask))
