"""Token export: every clip of every split through the trained tokenizer, once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.models.tokenizer.base import Stream, Tokenizer
from motionloom.pipeline.contract.showing import Bars, Showing
from motionloom.pipeline.contract.stage import SHOWING, Finished, Given, StageConfig, StageContext, StageKind
from motionloom.pipeline.stages.progress import bar
from motionloom.pipeline.store.networks import device_of
from motionloom.pipeline.store.tokens import TokenStore


class TokensConfig(StageConfig):
    """How clips are encoded."""

    batch_frames: int = Field(16384, ge=64)
    """Frames (padding included) in one encoder call."""


@dataclass(frozen=True)
class Tokens:
    """What a tokens stage gives: the codes of each split."""

    folder: Path
    streams: tuple[Stream, ...]

    def open(self, split: str) -> TokenStore:
        """Codes of the clips of one split."""
        return TokenStore.load(
            self.folder / f"tokens-{split}.safetensors", {s.name: s.per_group for s in self.streams}
        )


class TokensStage(StageKind):
    """Every clip of every split through the trained tokenizer, once."""

    name = "tokens"
    summary = "token export"
    config = TokensConfig
    takes = ("data", "stats", "tokenizer")

    def gives(self, config: Any) -> frozenset[str]:
        """Tokens of every clip."""
        return frozenset({"tokens", SHOWING})

    def run(self, context: StageContext) -> None:
        """Write `tokens-SPLIT.safetensors` for every split."""
        data, stats, tokenizer = (context.given[role] for role in ("data", "stats", "tokenizer"))
        for split in data.splits:
            dataset = data.split(split)
            with bar(context.console) as progress:
                task = progress.add_task(f"tokens {split}", total=len(dataset), note="")
                store = encode_split(
                    tokenizer.net,
                    dataset,
                    stats,
                    context.config.batch_frames,
                    partial(progress.advance, task),
                )
            store.save(context.folder / f"tokens-{split}.safetensors")
            whole = store.whole_clips()
            used = ", ".join(
                f"{s.name} {len(torch.unique(whole.codes[s.name]))}/{s.num_codes} codes"
                for s in tokenizer.net.streams
            )
            lacking = len(dataset) - len(whole.groups)
            note = f"; {lacking} clips lack hands or a face: no GPT learns tokens of those" if lacking else ""
            context.console.print(
                f"    {split}: {len(dataset)} clips, {int(store.starts[-1])} groups; {used}{note}"
            )

    def load(self, stage: Finished, given: Given, device: torch.device) -> Tokens:
        """The codes on disk."""
        return Tokens(stage.folder, tuple(given["tokenizer"].net.streams))

    def show(self, stage: Finished, given: Given) -> list[Showing]:
        """How often each code is used by the training clips."""
        out: list[Showing] = []
        tokens = self.load(stage, given, torch.device("cpu"))
        store = tokens.open("train").whole_clips()
        for stream in tokens.streams:
            uses = np.bincount(store.codes[stream.name].numpy(), minlength=stream.num_codes)
            used = int((uses > 0).sum())
            title = f"{used} of {stream.num_codes} codes used by the training clips"
            out.append(
                Bars(
                    f"{stage.name}, {stream.name}: {title}",
                    np.sort(uses)[::-1],
                    "code, most used first",
                    "uses",
                )
            )
        return out


def encode_split(
    tokenizer: Tokenizer,
    dataset: ClipDataset,
    stats: FeatureStats,
    batch_frames: int,
    advance: Callable[[int], None] | None = None,
) -> TokenStore:
    """Codes of all clips in order, encoded where the tokenizer lies.

    Clips are cut to a multiple of the group length and batched by length.
    """
    unit, device = tokenizer.group_frames, device_of(tokenizer)
    groups = np.maximum(np.asarray(dataset.frames) // unit, 1)
    starts = np.concatenate([[0], np.cumsum(groups)]).astype(np.int64)
    per_group = {s.name: s.per_group for s in tokenizer.streams}
    present = dataset.layout.present_columns[:, tokenizer.columns.cpu().numpy()]
    flat = {name: torch.zeros(int(starts[-1]) * n, dtype=torch.int64) for name, n in per_group.items()}
    for items in _by_length(groups, batch_frames // unit):
        motion, length = padded(tokenizer, dataset, stats, items)
        mask = torch.from_numpy(present[dataset.present[items]])
        found = tokenizer.encode(motion.to(device), length.to(device), mask.to(device))
        codes = {name: values.cpu() for name, values in found.items()}
        for row, item in enumerate(items.tolist()):
            for name, n in per_group.items():
                begin, count = int(starts[item]) * n, int(groups[item]) * n
                flat[name][begin : begin + count] = codes[name][row, :count]
        if advance is not None:
            advance(len(items))
    whole = np.asarray(present.all(axis=1))
    return TokenStore(flat, starts, per_group, whole[dataset.present])


def padded(
    tokenizer: Tokenizer, dataset: ClipDataset, stats: FeatureStats, items: NDArray[np.int64]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Normalised motion [B, T, D] zero-padded, and true lengths [B] (multiples of the group length).

    Columns that a clip does not hold are as stored: the tokenizer is told which ones.
    """
    unit, columns = tokenizer.group_frames, tokenizer.columns.cpu().numpy()
    lengths = [max(int(dataset.frames[i]) // unit, 1) * unit for i in items]
    motion = torch.zeros(len(items), max(lengths), len(columns))
    for row, (item, length) in enumerate(zip(items.tolist(), lengths, strict=True)):
        clip = stats.normalize(dataset.motion(item)[:length])[:, columns]
        # A clip shorter than one group stands still for the rest of it.
        clip = np.concatenate([clip, np.repeat(clip[-1:], length - len(clip), axis=0)])
        motion[row, :length] = torch.from_numpy(np.ascontiguousarray(clip))
    return motion, torch.tensor(lengths)


def _by_length(groups: NDArray[np.int64], budget: int) -> list[NDArray[np.int64]]:
    """Items in order of length, cut into batches of at most `budget` padded groups."""
    order = np.argsort(-groups, kind="stable")
    out: list[NDArray[np.int64]] = []
    start = 0
    while start < len(order):
        count = max(1, budget // int(groups[order[start]]))
        out.append(order[start : start + count])
        start += count
    return out
