"""Token export: every clip of every split through the trained tokenizer, once; batches of these tokens."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from motionloom.datasets.loading.plan import ALONE, Share
from motionloom.models.tokenizer.base import Stream, Tokenizer
from motionloom.pipeline.contract.showing import Bars, Showing
from motionloom.pipeline.contract.stage import (
    SHOWING,
    CompletedStage,
    Inputs,
    StageConfig,
    StageContext,
    StageKind,
    register,
)
from motionloom.pipeline.contract.units import Arrays
from motionloom.pipeline.store.networks import device_of
from motionloom.pipeline.training.config import SizedBatches
from motionloom.pipeline.training.trained_stage import Batches

if TYPE_CHECKING:
    from motionloom.datasets.loading.statistics import FeatureStats
    from motionloom.datasets.shards.clips import ClipDataset
    from motionloom.pipeline.store.tokens import GptClips, TokenBatches, TokenStore


class TokensConfig(StageConfig):
    """Settings of encoding clips."""

    batch_frames: int = Field(16384, ge=64)
    """Frames (padding included) in one encoder call."""


@dataclass(frozen=True)
class Tokens:
    """The codes of each split."""

    folder: Path
    streams: tuple[Stream, ...]

    def open(self, split: str) -> TokenStore:
        from motionloom.pipeline.store.tokens import TokenStore

        return TokenStore.load(
            self.folder / f"tokens-{split}.safetensors", {s.name: s.per_group for s in self.streams}
        )


class TokensStage(StageKind[TokensConfig]):
    """Every clip of every split through the trained tokenizer, once."""

    name = "tokens"
    summary = "token export"
    config = TokensConfig
    offers = frozenset({"tokens", SHOWING})
    takes = ("data", "stats", "tokenizer")
    shares = True

    def share(self, context: StageContext) -> None:
        from motionloom.datasets.base.progress import Meter

        for encoded in self._splits(context):
            sizes = [len(items) for items in encoded.batches]
            split = encoded.dataset.split
            total = context.units.mine(sizes)
            with Meter(f"tokens {split}", total, console=context.console) as meter:
                context.units.make(
                    split,
                    len(sizes),
                    encoded.codes,
                    lambda k, meter=meter, sizes=sizes: meter.advance(sizes[k]),  # type: ignore[misc]
                )

    def run(self, context: StageContext) -> None:
        for encoded in self._splits(context):
            split = encoded.dataset.split
            count = len(encoded.dataset)
            store = encoded.store(context.units.read(split, len(encoded.batches)))
            store.save(context.folder / f"tokens-{split}.safetensors")
            used = ", ".join(
                f"{s.name} {len(torch.unique(store.whole_codes(s.name)))}/{s.num_codes} codes"
                for s in encoded.tokenizer.streams
            )
            lacking = int((~store.whole).sum())
            note = f"; {lacking} clips lack hands or a face: no GPT learns tokens of those" if lacking else ""
            context.console.print(f"    {split}: {count} clips, {int(store.starts[-1])} groups; {used}{note}")
        context.units.clear()

    @staticmethod
    def _splits(context: StageContext) -> Iterator[EncodedSplit]:
        data, stats, tokenizer = (context.given[role] for role in ("data", "stats", "tokenizer"))
        for split in data.splits:
            yield EncodedSplit(tokenizer.net, data.split(split), stats, context.config.batch_frames)

    def load(self, stage: CompletedStage, given: Inputs, device: torch.device) -> Tokens:
        return Tokens(stage.folder, tuple(given["tokenizer"].net.streams))

    def show(self, stage: CompletedStage, given: Inputs) -> list[Showing]:
        """Usage of each code by the training clips."""
        out: list[Showing] = []
        tokens = self.load(stage, given, torch.device("cpu"))
        store = tokens.open("train")
        for stream in tokens.streams:
            uses = np.bincount(store.whole_codes(stream.name).numpy(), minlength=stream.num_codes)
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


class EncodedSplit:
    """Yield the codes of all clips of a split, cut to whole groups, in batches of like length."""

    def __init__(
        self, tokenizer: Tokenizer, dataset: ClipDataset, stats: FeatureStats, batch_frames: int
    ) -> None:
        self.tokenizer = tokenizer
        self.dataset = dataset
        self.stats = stats
        unit = tokenizer.group_frames
        self.groups = np.maximum(np.asarray(dataset.frames) // unit, 1)
        self.batches = _by_length(self.groups, batch_frames // unit)
        """Clip numbers of each batch."""
        self._present = dataset.layout.present_columns[:, tokenizer.columns.cpu().numpy()]

    def codes(self, batch: int) -> Arrays:
        """Codes int64 [B, G * per_group] of one batch, by stream."""
        items = self.batches[batch]
        device = device_of(self.tokenizer)
        motion, length = padded(self.tokenizer, self.dataset, self.stats, items)
        mask = torch.from_numpy(self._present[self.dataset.present[items]])
        found = self.tokenizer.encode(motion.to(device), length.to(device), mask.to(device))
        return {name: values.cpu().numpy() for name, values in found.items()}

    def store(self, codes: Iterable[Arrays]) -> TokenStore:
        """All batches' codes, in order, as one store in the order of the clips."""
        from motionloom.pipeline.store.tokens import TokenStore

        starts = np.concatenate([[0], np.cumsum(self.groups)]).astype(np.int64)
        per_group = {s.name: s.per_group for s in self.tokenizer.streams}
        flat = {name: torch.zeros(int(starts[-1]) * n, dtype=torch.int64) for name, n in per_group.items()}
        for items, found in zip(self.batches, codes, strict=True):
            for row, item in enumerate(items.tolist()):
                for name, n in per_group.items():
                    begin = int(starts[item]) * n
                    count = int(self.groups[item]) * n
                    flat[name][begin : begin + count] = torch.from_numpy(found[name][row, :count])
        whole = np.asarray(self._present.all(axis=1))
        return TokenStore(flat, starts, per_group, whole[self.dataset.present])


class OverTokens(Protocol):
    """A network over interleaved codes."""

    names: tuple[str, ...]
    pattern: tuple[str, ...]
    num_codes: dict[str, int]
    max_groups: int


def token_batches(
    net: OverTokens,
    clips_of: Callable[[str], GptClips],
    held_out: str,
    seed: int,
    tables: Callable[[GptClips], dict[str, Any]],
    wrap: Callable[[GptClips, TokenBatches], SizedBatches] = lambda _, batches: batches,
) -> Batches:
    """Batches of the tokens of captioned clips.

    Args:
        clips_of: The clips of a split.
        held_out: The split of validation.
        tables: What captions are read as: `prior`, `similarity` and `latents` of `TokenBatches`.
        wrap: Makes other batches of these.
    """
    from motionloom.pipeline.store.tokens import TokenBatches

    def batches(split: str, training: bool, batch: int, share: Share = ALONE) -> SizedBatches:
        clips = clips_of(split)
        found = TokenBatches(
            clips.store, clips.captions, pattern=net.pattern, ends=net.num_codes, max_groups=net.max_groups,
            batch_size=batch, seed=seed, share=share, training=training,
            sources=clips.sources, present=clips.present, **tables(clips),
        )  # fmt: skip
        return wrap(clips, found)

    return Batches(partial(batches, "train", True), partial(batches, held_out, False, 32))


def token_example(net: OverTokens, batch: int) -> dict[str, Tensor]:
    """Return the longest sequences of a network, closed: tokens without meaning and their kinds."""
    order = torch.tensor([net.names.index(name) for name in (net.pattern * net.max_groups + net.names)])
    tokens = torch.zeros(batch, len(order), dtype=torch.int64)
    return {"tokens": tokens, "kinds": order.expand(batch, -1)}


def padded(
    tokenizer: Tokenizer, dataset: ClipDataset, stats: FeatureStats, items: NDArray[np.int64]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Normalised motion [B, T, D] zero-padded, and true lengths [B] (multiples of the group length).

    Columns that a clip does not hold are as stored: the tokenizer is told which ones.
    """
    unit = tokenizer.group_frames
    columns = tokenizer.columns.cpu().numpy()
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


register(TokensStage())
