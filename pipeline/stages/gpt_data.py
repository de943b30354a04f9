"""What a GPT trains on: the clips of a split with tokens that it may learn, and their captions.

A clip without a caption (of the face, for the face GPT) is left out. So is one that lacks a part whose tokens
say more than that part: their codes would teach what was never recorded. A clip that lacks a part with a
stream of its own (hands, in H2VQ) stays; that stream's tokens are neither predicted nor read.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.loading.spans import CaptionSpan, caption_spans
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.clips import ClipDataset, in_order
from motionloom.datasets.shards.order import Source
from motionloom.models.gpt.tokens import stream_names
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.pipeline.store.data import captions_of
from motionloom.pipeline.store.tokens import PresentTokens, TokenCaption, TokenStore


@dataclass(frozen=True)
class GptClips:
    """Clips of one split, n of them, and m different captions."""

    store: TokenStore
    """Their tokens alone."""
    captions: list[list[TokenCaption]]
    """Those of each clip, n lists."""
    texts: list[str]
    """All captions, [m]."""
    present: PresentTokens | None
    """Which of their tokens were recorded; None when all were."""
    sources: tuple[Source, ...]
    ids: tuple[str, ...]
    """Their names."""
    uncaptioned: int
    """Clips that were left out because they have no caption."""


def gpt_clips(
    dataset: ClipDataset, store: TokenStore, tokenizer: Tokenizer, *, face: bool, min_frames: int
) -> GptClips:
    """The clips of `dataset` that a GPT over the tokens of `tokenizer` can train on.

    `store` holds the tokens of all clips. Captions about fewer than `min_frames` frames give way to longer
    ones of the same clip.
    """
    table = present_table(tokenizer, dataset.layout)
    usable = table.usable[dataset.present]
    if not usable.any():
        raise UserError(
            f"{dataset.where}: no clip of split '{dataset.split}' holds all that the tokenizer models "
            f"(hands, face): train a tokenizer of another `part`, or take other data"
        )
    member = "face_texts.json" if face else "texts.json"
    chosen = usable & dataset.has(member)
    clips = np.flatnonzero(chosen)
    if len(clips) == 0:
        kind = "face caption" if face else "caption"
        raise UserError(
            f"{dataset.where}: no clip of split '{dataset.split}' has a {kind} to train a GPT on; "
            f"convert data with {kind}s"
        )
    own = store.of(chosen)
    rows: dict[str, int] = {}
    captions = []
    for number, index in enumerate(in_order(dataset, member, clips=clips.tolist())):
        found, frames = captions_of(dataset, index, face=face), int(dataset.frames[index])
        spans = caption_spans(found, dataset.layout.fps, frames, min_frames)
        groups = int(own.groups[number])
        captions.append([_caption(span, groups, tokenizer.group_frames, rows) for span in spans])
    bits = torch.from_numpy(dataset.present[clips].astype(np.int64))
    return GptClips(
        own,
        captions,
        list(rows),
        None if table.streams[bits].all() else PresentTokens(bits, table.streams, table.columns),
        # Weights count; the order of shards does not, as the tokens are all in memory.
        tuple(replace(source, shards=None) for source in dataset.sources(clips)),
        tuple(dataset.ids[clip] for clip in clips.tolist()),
        int((usable & ~chosen).sum()),
    )


def _caption(span: CaptionSpan, groups: int, unit: int, rows: dict[str, int]) -> TokenCaption:
    """The groups whose borders are nearest to the caption's, at least one."""
    first = min((span.first + unit // 2) // unit, groups - 1)
    end = min(max((span.end + unit // 2) // unit, first + 1), groups)
    return TokenCaption(rows.setdefault(span.text, len(rows)), first, end)


@dataclass(frozen=True)
class PresentTable:
    """What clips with the bits b (row b, see `ClipMeta.present`) have of a tokenizer's input and output."""

    columns: Tensor
    """bool [4, C]: columns of the tokenizer."""
    streams: Tensor
    """bool [4, K]: streams whose tokens say what was recorded, in the order of `stream_names`."""
    usable: NDArray[np.bool_]
    """[4]: whether any stream is left that a GPT can learn."""


def present_table(tokenizer: Tokenizer, layout: MotionLayout) -> PresentTable:
    """The table of a tokenizer and the layout of the full frames."""
    columns = torch.from_numpy(layout.present_columns[:, tokenizer.columns.cpu().numpy()])
    found = tokenizer.missing(columns.to(tokenizer.columns.device))
    missing = {name: value.cpu() for name, value in found.items()}
    # A tokenizer that gives a part a stream of its own keeps that part out of the other streams.
    others = torch.ones(len(columns), dtype=torch.bool) if missing else columns.all(1)
    known = [~missing[name] if name in missing else others for name in stream_names(tokenizer.pattern)]
    streams = torch.stack(known, dim=1)
    return PresentTable(columns, streams, streams.any(1).numpy())
