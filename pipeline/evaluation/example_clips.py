"""Clips of a held-out split as prompts: a model is asked for what the clip is about or dances to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.evaluation.truth import Truth, spread, truth_of
from motionloom.pipeline.inference.bundle import Bundle, GeneratedMotion

_MEMBERS = {"text": "texts.json", "audio": "audio.flac"}
"""What a clip must hold for a prompt of each modality."""


@dataclass(frozen=True)
class ExampleClip:
    """A clip, and what of it a model is conditioned on."""

    truth: Truth
    sound: Sound | None
    """The music of the clip, where the model is conditioned on music and the clip has some."""

    @property
    def title(self) -> str:
        """Its words, or the clip's name where it has none."""
        return self.truth.caption or f"to the music of {self.truth.id}"


def example_clips(dataset: ClipDataset, count: int, modalities: Set[str]) -> list[ExampleClip]:
    """At most `count` clips spread over a split that hold something of the `modalities`."""
    if modalities == {"text"}:
        chosen = spread(dataset, count)
    else:
        order = np.random.default_rng(0).permutation(len(dataset))
        chosen = order[_usable(dataset, modalities)[order]][:count].tolist()
    return [_example(dataset, index, modalities) for index in chosen]


def perform(
    bundle: Bundle,
    shown: Sequence[ExampleClip],
    *,
    seed: int,
    sampling: SamplingConfig | Mapping[str, Any] | None = None,
) -> list[GeneratedMotion]:
    """A motion for each example, of its words, its music or both, as the model is conditioned on."""
    modalities = bundle.generator.modalities
    words, music = "text" in modalities, "audio" in modalities
    return bundle.generate(
        [one.truth.caption for one in shown] if words else None,
        face_captions=[one.truth.face_caption for one in shown] if words else None,
        sounds=[one.sound for one in shown] if music else None,
        seed=seed,
        sampling=sampling,
    )


def _usable(dataset: ClipDataset, modalities: Set[str]) -> NDArray[np.bool_]:
    found = np.zeros(len(dataset), dtype=np.bool_)
    for name in modalities & _MEMBERS.keys():
        found |= dataset.has(_MEMBERS[name])
    if not found.any():
        wanted = " or ".join(sorted({"text": "a caption", "audio": "sound"}[name] for name in modalities))
        raise UserError(f"{dataset.where}: no clip of split '{dataset.split}' has {wanted}")
    return found


def _example(dataset: ClipDataset, index: int, modalities: Set[str]) -> ExampleClip:
    truth = truth_of(dataset, index)
    stored = dataset.wav(index) if "audio" in modalities else None
    sound = None if stored is None else Sound(*stored)
    # A clip is cut where its caption is about a stretch of it; the music is that of the same stretch.
    if sound is None or sound.seconds <= truth.begin:
        return ExampleClip(truth, None)
    seconds = len(truth.features) / dataset.layout.fps
    return ExampleClip(truth, sound.slice(truth.begin, truth.begin + seconds))
