"""From prompts, as people give them, to the `Conditions` that networks take."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.conditions import Condition, Conditions
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.store.text import TextSource

if TYPE_CHECKING:
    from motionloom.datasets.audio.sound import Sound

_PIECES = 4
"""Pieces whose features are kept: several samples of one song, or segments of one, are heard once."""


class PromptEncoder:
    """Encodes prompts for one generator, with the text encoder that it was trained with."""

    def __init__(self, text: TextSource | None, device: torch.device) -> None:
        self.text, self.device = text, device
        self._heard: list[tuple[Sound, float, float, NDArray[np.float32]]] = []
        """Pieces lately heard from a second on, at frames a second, and their features."""

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
        rows: list[Tensor | None] = []
        for prompt in prompts:
            found = prompt.music
            if found is None and prompt.sound is not None:
                found = self._features(prompt.sound, fps)
            rows.append(None if found is None else torch.from_numpy(np.ascontiguousarray(found)))
        return _padded(rows, lambda value: value.to(self.device))

    def _features(self, sound: Sound, fps: float) -> NDArray[np.float32]:
        """A row for each frame of a sound, by all of the piece that it is a slice of.

        Tempo and beats are read from many seconds around a frame, in training too: a slice heard alone would
        look different.
        """
        from motionloom.datasets.audio.lineup import motion_frame_features

        piece = sound.piece or sound
        # The piece is heard from within a frame's length on, so that its rows lie on the motion's frames.
        first = int(sound.begin * fps + 1e-6)
        lead = max(0.0, sound.begin - first / fps)
        known = next((rows for p, at, f, rows in self._heard if p is piece and (at, f) == (lead, fps)), None)
        if known is None:
            whole = piece.slice(lead) if round(lead * piece.rate) else piece
            known = motion_frame_features(whole, None, fps, max(1, round(whole.seconds * fps)))
            self._heard = [*self._heard[1 - _PIECES :], (piece, lead, fps, known)]
        frames = max(1, round(sound.seconds * fps))
        return known[np.minimum(np.arange(first, first + frames), len(known) - 1)]


def _padded(rows: Sequence[Tensor | None], move: Callable[[Tensor], Tensor]) -> Condition:
    """Rows [L_i, E], or None, as one condition."""
    width = next(row.shape[1] for row in rows if row is not None)
    longest = max(len(row) for row in rows if row is not None)
    features, mask = torch.zeros(len(rows), longest, width), torch.zeros(len(rows), longest, dtype=torch.bool)
    for k, row in enumerate(rows):
        if row is not None:
            features[k, : len(row)], mask[k, : len(row)] = row, True
    return Condition(move(features), move(mask))
