"""Motion tokens on disk, and the batches the GPTs train on.

One `tokens-SPLIT.safetensors` per split: for each stream the codes of all clips end to end, and where each
clip begins, counted in groups of four frames. Written once by the `tokens` stage, never re-encoded by a GPT.

A clip that lacks a part which the tokenizer models (hands, face) has codes, but some of them say what was
never recorded: clips that lack nothing are marked (`whole`). A GPT leaves out clips without a caption (of the
face, for the face GPT) and those that lack a part whose tokens say more than that part. A clip that lacks a
part with a stream of its own (hands, in H2VQ) stays; that stream's tokens are neither predicted nor read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from operator import itemgetter
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor
from torch.utils.data import Dataset

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import atomic_path
from motionloom.datasets.base.pool import Workers, usable_cores
from motionloom.datasets.loading.crops import caption_spans
from motionloom.datasets.loading.plan import ALONE, BatchPlan, Share
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.clips import ClipDataset, Source
from motionloom.models.gpt.tokens import TokenSequence, interleave, known_tokens, stream_names
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.pipeline.store.data import captions_of
from motionloom.pipeline.store.files import made_once

Codes = dict[str, Tensor]
_OF_A_WORKER = 2**15
"""Clips whose captions a process of its own reads, one of at most eight, as each takes 300 MB to start."""


@dataclass(frozen=True)
class TokenStore:
    """Codes of every clip of a split, integers [sum]: those of a file are mapped, and all processes share
    them. `groups[i]` is the length of clip i in groups.
    """

    codes: Codes
    starts: NDArray[np.int64]
    per_group: Mapping[str, int]
    whole: NDArray[np.bool_]
    """Clips that hold all the columns the tokenizer models, [n]."""
    file: Path | None = None
    """The file that all of it is in."""

    def __reduce__(self) -> Any:  # another process maps the file, too
        kept = (self.codes, self.starts, self.per_group, self.whole)
        return (TokenStore, kept) if self.file is None else (TokenStore.load, (self.file, self.per_group))

    @property
    def groups(self) -> NDArray[np.int64]:
        return np.diff(self.starts)

    def stretches(self, begin: NDArray[np.int64], count: NDArray[np.int64]) -> Codes:
        """Codes of groups `begin` + 0 .. `count` [B], int64 [B, most * per_group] a stream, with padding."""
        places = begin[:, None] + np.arange(count.max())
        groups = torch.from_numpy(np.minimum(places, self.starts[-1] - 1))
        return {
            name: flat.view(-1, self.per_group[name])[groups].flatten(1).long()
            for name, flat in self.codes.items()
        }

    def whole_codes(self, name: str) -> Tensor:
        """The codes of a stream in the whole clips."""
        return self.codes[name][torch.from_numpy(np.repeat(self.whole, self.groups * self.per_group[name]))]

    def save(self, path: Path) -> None:
        tensors = {f"codes.{name}": flat.to(torch.int32) for name, flat in self.codes.items()}
        tensors["starts"] = torch.from_numpy(self.starts)
        tensors["whole"] = torch.from_numpy(self.whole)
        with atomic_path(path) as temporary:
            temporary.write_bytes(save(tensors))

    @staticmethod
    def load(path: Path, per_group: Mapping[str, int]) -> TokenStore:
        """Read a store; its streams must be the tokenizer's."""
        if not path.is_file():
            raise UserError(f"{path}: no tokens; run the tokens stage for this split")
        try:
            tensors = load_file(path)
            starts = tensors["starts"].numpy()
            whole = tensors["whole"].numpy()
        except (SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
            raise UserError(f"{path}: cannot be read ({error}); run the tokens stage again") from None
        codes = {k.removeprefix("codes."): v for k, v in tensors.items() if k.startswith("codes.")}
        if set(codes) != set(per_group):
            raise UserError(f"{path}: holds streams {sorted(codes)}, the tokenizer has {sorted(per_group)}")
        # Clips lie one after the other, and together they are all that is there.
        fits = starts.dtype == np.int64 and whole.dtype == np.bool_ and starts.shape == (len(whole) + 1,)
        fits = fits and starts[0] == 0 and bool((np.diff(starts) > 0).all())
        for name, flat in codes.items():
            fits = fits and flat.shape == (starts[-1] * per_group[name],) and bool((flat >= 0).all())
        if not fits:
            raise UserError(f"{path}: not the codes of clips one after the other; run the tokens stage again")
        return TokenStore(codes, starts, per_group, whole, path)


@dataclass(frozen=True)
class TokenCaptions:
    """The captions of n clips, m in all, clip by clip, and the groups of their clips that they are about."""

    starts: NDArray[np.int64]
    """Number of each clip's first caption, and m, [n + 1]; every clip has one."""
    rows: NDArray[np.int64]
    """Rows in the list of all different captions, [m]."""
    first: NDArray[np.int64]
    count: NDArray[np.int64]
    """Groups, [m]."""
    clips: NDArray[np.int64]
    """Numbers of the clips in the split, [n]."""

    def __len__(self) -> int:
        return len(self.clips)

    @staticmethod
    def of(counts: NDArray[np.int64], captions: NDArray[np.int64], clips: NDArray[np.int64]) -> TokenCaptions:
        """So many of the `captions`, (row, first, count) [m, 3], are of each of the `clips`."""
        rows, first, count = captions.T.copy()
        return TokenCaptions(np.append(0, counts.cumsum()), rows, first, count, clips)


@dataclass(frozen=True)
class PresentTokens:
    """Recorded tokens and columns of n clips, by the bits of `ClipMeta.present`."""

    bits: Tensor
    """Bits of each clip, int64 [n]."""
    streams: Tensor
    """bool [4, K]: row b, streams of clips that hold the bits b."""
    columns: Tensor
    """bool [4, C]: the same for the tokenizer's columns."""

    def known(self, items: Sequence[int] | NDArray[np.int64], batch: TokenSequence, ends: Tensor) -> Tensor:
        """Bool [B, L]: false at codes of streams that the clips `items` [B] lack; `ends` int64 [K]."""
        return known_tokens(self.streams[self.bits[items]], batch, ends)


class CaptionTable(Protocol):
    """A vector for each caption: a tensor, or what reads it from the disk."""

    def __getitem__(self, rows: NDArray[np.int64], /) -> Tensor: ...


@dataclass(frozen=True)
class TokenBatches(Dataset[dict[str, Any]]):
    """Batch k of token sequences and text priors; a pure function of (seed, k).

    In training a rank's share of an endless order, with one caption drawn for each clip; else the clips in
    order, all of them on every rank, with their first captions. A sequence is the stretch that its caption is
    about, and ends where that ends.
    """

    store: TokenStore
    captions: TokenCaptions
    """The clips' captions; their rows are rows of `prior`."""
    prior: CaptionTable
    """Text embeddings [n, E]."""
    similarity: CaptionTable
    """sBERT embeddings of the same captions [n, S]: which negatives of the alignment loss to leave out."""
    pattern: tuple[str, ...]
    ends: Mapping[str, int]
    max_groups: int
    batch_size: int
    seed: int
    share: Share = ALONE
    training: bool = True
    sources: tuple[Source, ...] = ()
    """Data sets and their weights, when several are mixed."""
    latents: CaptionTable | None = None
    """TMA's embeddings of the same captions [n, Z], for an alignment loss where `prior` is something else."""
    present: PresentTokens | None = None
    """Which tokens of the clips were recorded; None = all. Batches then also hold "known" bool [B, L] and
    "present" bool [B, C]."""

    def __post_init__(self) -> None:
        for name, codes in self.store.codes.items():
            if len(codes) and not 0 <= int(codes.min()) <= int(codes.max()) < self.ends[name]:
                raise UserError(
                    f"stream '{name}' holds tokens outside its {self.ends[name]} codes: another tokenizer "
                    "made them; run the tokens stage again"
                )

    @cached_property
    def _plan(self) -> BatchPlan:
        starts = self.captions.starts
        spans = np.add.reduceat(self.captions.count, starts[:-1]) // np.diff(starts)
        lengths = np.minimum(spans, self.max_groups)
        return BatchPlan(len(self.captions), self.batch_size, self.seed, lengths, self.sources)

    def __len__(self) -> int:
        return -(-len(self.captions) // self.batch_size)

    def __getitem__(self, k: int) -> dict[str, Any]:
        if self.training:
            turns, items = self._plan.local(k, self.share)
        else:
            items = np.arange(k * self.batch_size, min((k + 1) * self.batch_size, len(self.captions)))
            turns = np.zeros(len(items), dtype=np.int64)
        captions, first, groups = self._drawn(items, turns)
        rows = self.captions.rows[captions]
        batch = self._sequences(
            self.store.starts[self.captions.clips[items]] + first,
            groups,
            groups == self.captions.count[captions],
        )
        more = {} if self.latents is None else {"tma_text": self.latents[rows]}
        if self.present is not None:
            ends = torch.tensor([self.ends[name] for name in stream_names(self.pattern)])
            more["known"] = self.present.known(items, batch, ends)
            more["present"] = self.present.columns[self.present.bits[items]]
        return {
            "tokens": batch.tokens,
            "kinds": batch.kinds,
            "length": batch.length,
            "text": self.prior[rows],
            "similarity": self.similarity[rows],
            **more,
        }

    def _drawn(
        self, items: NDArray[np.int64], turns: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """A caption of each clip, and first group and length of its stretch, at most a block; each [B]."""
        own = self.captions
        chosen = self.captions.starts[items]
        skipped = np.zeros_like(items)
        choices = own.starts[items + 1] - chosen
        if self.training:
            # Seeded by clip and turn, so that no order of batches and no number of ranks changes a draw: as
            # `default_rng([seed, turn, item])`, in words of 32 bits, which are read faster.
            seed = [self.seed >> bit & 0xFFFFFFFF for bit in range(0, max(1, self.seed.bit_length()), 32)]
            keys = np.column_stack([np.tile(seed, (len(items), 1)), turns, items]).astype(np.uint32)
            rngs = [np.random.Generator(np.random.PCG64(key)) for key in keys]
            chosen += [rng.integers(many) for rng, many in zip(rngs, choices.tolist(), strict=True)]
            more = own.count[chosen] - self.max_groups
            for row in np.flatnonzero(more > 0).tolist():
                skipped[row] = rngs[row].integers(more[row] + 1)
        return chosen, own.first[chosen] + skipped, np.minimum(own.count[chosen], self.max_groups)

    def _sequences(
        self, begin: NDArray[np.int64], groups: NDArray[np.int64], closed: NDArray[np.bool_]
    ) -> TokenSequence:
        """The sequences of `groups` [B] groups from group `begin` [B] of the split on."""
        codes = self.store.stretches(begin, groups)
        count = torch.from_numpy(groups)
        batch = interleave(codes, self.pattern, ends=self.ends, groups=count, closed=torch.from_numpy(closed))
        longest = int(batch.length.max())  # the longest row may have no End
        return TokenSequence(batch.tokens[:, :longest], batch.kinds[:, :longest], batch.length)


@dataclass(frozen=True)
class GptClips:
    """Clips of one split, n of them, and m different captions."""

    store: TokenStore
    """Tokens of all clips of the split."""
    captions: TokenCaptions
    tables: Mapping[str, Any]
    """What `of_texts` has made of the texts of all different captions, [m]."""
    present: PresentTokens | None
    """Mask of their recorded tokens; None if all were recorded."""
    sources: tuple[Source, ...]
    uncaptioned: int
    """Clips that were left out because they have no caption."""

    @property
    def texts(self) -> list[str]:
        """Texts of all different captions, where `of_texts` has not made something else of them."""
        return list(self.tables["texts"])


def gpt_clips(
    dataset: ClipDataset,
    store: TokenStore,
    tokenizer: Tokenizer,
    *,
    face: bool,
    min_frames: int,
    of_texts: Callable[[list[str]], Mapping[str, Any]] = lambda texts: {"texts": texts},
    note: Path | None = None,
) -> GptClips:
    """The clips of `dataset` that a GPT over the tokens of `tokenizer` can train on.

    `store` holds the tokens of all clips. Captions about fewer than `min_frames` frames give way to longer
    ones of the same clip. With `note`, a folder, one process reads the captions and writes there what they
    are, and what `of_texts` makes of them, as arrays, which all map.
    """
    # Clips of which no stream says what was recorded cannot be learned from.
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

    def read() -> dict[str, Any]:
        parts = np.array_split(np.stack([clips, store.groups[clips]]), -(-len(clips) // _OF_A_WORKER), axis=1)
        work = partial(_captions, dataset, tokenizer.group_frames, face, min_frames)
        with Workers(min(8, usable_cores())) as workers:
            done = [found for _, found in sorted(workers.run(work, parts), key=itemgetter(0))]
        # Equal captions share one row of the text embeddings.
        rows: dict[str, int] = {}
        for texts, _, captions in done:
            own = np.array([rows.setdefault(text, len(rows)) for text in texts], dtype=np.int64)
            captions[:, 0] = own[captions[:, 0]]
            texts.clear()
        counts, captions = (np.concatenate([found[k] for found in done]) for k in (1, 2))
        return {**vars(TokenCaptions.of(counts, captions, clips)), **of_texts(list(rows))}

    tables = read() if note is None else made_once(note, read)
    own = TokenCaptions(**{field.name: tables.pop(field.name) for field in fields(TokenCaptions)})
    bits = torch.from_numpy(dataset.present[clips].astype(np.int64))
    return GptClips(
        store,
        own,
        tables,
        None if table.streams[bits].all() else PresentTokens(bits, table.streams, table.columns),
        # Weights count; the order of shards does not, as the tokens are all in memory.
        tuple(replace(source, shards=None) for source in dataset.sources(clips)),
        int((usable & ~chosen).sum()),
    )


def _captions(
    dataset: ClipDataset, unit: int, face: bool, min_frames: int, clips: NDArray[np.int64]
) -> tuple[list[str], NDArray[np.int64], NDArray[np.int64]]:
    """Different captions of clips, (number, groups) [2, n]; how many each has; and of each its row in the
    first, first group and number of the groups whose borders, `unit` frames apart, are nearest to it, at
    least one.
    """
    rows: dict[str, int] = {}
    counts = []
    out = []
    for index, groups in clips.T.tolist():
        captions = captions_of(dataset, index, face=face)
        spans = caption_spans(captions, dataset.layout.fps, int(dataset.frames[index]), min_frames)
        counts.append(len(spans))
        for span in spans:
            first = min((span.first + unit // 2) // unit, groups - 1)
            end = min(max((span.end + unit // 2) // unit, first + 1), groups)
            out.append((rows.setdefault(span.text, len(rows)), first, end - first))
    return list(rows), np.array(counts, dtype=np.int64), np.array(out, dtype=np.int64).reshape(-1, 3)


@dataclass(frozen=True)
class PresentTable:
    """Parts of a tokenizer's input and output in clips; row b: clips with the bits b (`ClipMeta.present`)."""

    columns: Tensor
    """bool [4, C]: columns of the tokenizer."""
    streams: Tensor
    """bool [4, K]: streams whose tokens say what was recorded, in the order of `stream_names`."""
    usable: NDArray[np.bool_]
    """[4]: whether any stream is left that a GPT can learn."""


def present_table(tokenizer: Tokenizer, layout: MotionLayout) -> PresentTable:
    """The table of a tokenizer and the layout of the full frames."""
    columns = torch.from_numpy(layout.present_columns[:, tokenizer.columns.cpu().numpy()])
    streams = tokenizer.recorded(columns.to(tokenizer.columns.device)).cpu()
    return PresentTable(columns, streams, streams.any(1).numpy())
