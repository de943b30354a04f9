"""Other wordings of captions, made with the text encoder alone [ours].

A small set says the same in the same few words again and again; a model that learns from it knows those
words and no others. Here words give way to words that the encoder finds near them, now and then a word is
left out, and the full stop may be: "a person raises the left hand." becomes "a person raise left hand". What
a rewording says is roughly the same, not exactly: it is for training encoders of text, never shown to anyone.

- Candidates are the whole words of the encoder's vocabulary that occur in no caption. So "left" never becomes
  "right" where captions speak of both, and opposites that a language model finds alike stay apart.
- A candidate stands for a word if its cosine is at least `nearness`, and no other word of the captions is
  nearer to it by more than `MARGIN`.
- Every draw is a function of (caption, number of the rewording, position).
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from motionloom.datasets.base.files import write_json
from motionloom.datasets.base.randomness import uniform
from motionloom.datasets.schema import Config, UserError
from motionloom.datasets.text.build import build_with_encoder
from motionloom.datasets.text.cache import TextCache, key_of
from motionloom.datasets.text.encoder import TextEncoder

MARGIN = 0.1
"""How much nearer another word of the captions may be to a candidate."""

_WORD = re.compile(r"[^\W\d_]+")
_PIECE = re.compile(r"[^\W\d_]+|[\W\d_]+")
_BATCH = 256
_FILE = "rewordings.json"


class RewordConfig(Config):
    """How captions are reworded, and how often training takes a rewording."""

    count: int = Field(2, ge=1)
    """Rewordings of each caption."""
    share: float = Field(0.6, ge=0, le=1)
    """How often training reads a rewording in a caption's place."""
    replace: float = Field(0.3, ge=0, le=1)
    """Chance of a word with neighbours to give way to one of them."""
    drop: float = Field(0.1, ge=0, lt=1)
    """Chance of any other word to be left out."""
    nearness: float = Field(0.55, ge=-1, le=1)
    """Least cosine of a word and what takes its place, by the encoder."""
    neighbours: int = Field(6, ge=1)
    """Words at most that one word may give way to: its nearest."""


Neighbours = Mapping[str, Sequence[str]]
"""Word of the captions -> words that may take its place, nearest first."""


def whole_words(vocabulary: Iterable[str]) -> list[str]:
    """The lower-case words of three letters or more among a tokenizer's pieces, sorted.

    Pieces that open a word are marked in some vocabularies, those that close one or go on in others.
    """
    pieces = list(vocabulary)
    opened = [p[1:] for p in pieces if p[:1] in ("Ġ", "▁")]
    closed = [p.removesuffix("</w>") for p in pieces if p.endswith("</w>")]
    words = opened or closed or pieces
    return sorted({w for w in words if len(w) >= 3 and _WORD.fullmatch(w) and w == w.lower()})


def neighbours(
    captions: Iterable[str], vocabulary: Sequence[str], encoder: TextEncoder, config: RewordConfig
) -> Neighbours:
    """What each word of `captions` may become, of the words in `vocabulary` that no caption has."""
    known = sorted({word for caption in captions for word in _WORD.findall(caption.lower())})
    new = sorted(set(vocabulary) - set(known))
    if not known or not new:
        return {}
    # Rounded, so that the order does not hang on the last bits.
    cosine = (_sentences(encoder, known) @ _sentences(encoder, new).T).round(3)
    allowed = (cosine >= config.nearness) & (cosine >= cosine.max(axis=0) - MARGIN)
    order = np.argsort(-np.where(allowed, cosine, -np.inf), axis=1, kind="stable")[:, : config.neighbours]
    found = (
        (word, [new[j] for j in row if allowed[i, j]])
        for i, (word, row) in enumerate(zip(known, order.tolist(), strict=True))
    )
    return {word: near for word, near in found if near}


def reword(caption: str, near: Neighbours, number: int, config: RewordConfig) -> str:
    """Rewording `number` of a caption; the caption itself if nothing would be left of it."""
    pieces = _PIECE.findall(caption)
    key = int.from_bytes(key_of(caption)[:8], "big")
    draws = uniform(key, number, np.arange(len(pieces) + 1)[:, None], np.arange(3))
    out = []
    for piece, (gives_way, which, dropped) in zip(pieces, draws.tolist(), strict=False):
        choices = near.get(piece.lower(), ())
        if not _WORD.fullmatch(piece):
            out.append(piece)
        elif choices and gives_way < config.replace:
            out.append(choices[int(which * len(choices))])
        elif dropped >= config.drop:
            out.append(piece)
    said = re.sub(r"\s+([,.;:!?])", r"\1", " ".join("".join(out).split())).lstrip(" ,;:")
    if draws[-1, 0] < 0.5:
        said = said.rstrip(".")
    return said if _WORD.search(said) else caption


def _sentences(encoder: TextEncoder, words: Sequence[str]) -> NDArray[np.float32]:
    spans = range(0, len(words), _BATCH)
    return np.concatenate([encoder.encode(words[first : first + _BATCH]).sentence for first in spans])


class Rewordings:
    """Rewordings of captions, encoded; cheap to pickle into loader workers.

    | file              | content |
    |-------------------|---------|
    | `rewordings.json` | how often they are taken, and caption -> its rewordings |
    | `cache/`          | a text cache of the rewordings |
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        read = json.loads((folder / _FILE).read_text(encoding="utf-8"))
        self.share = float(read["share"])
        self._said: dict[str, list[str]] = read["captions"]
        self.cache = TextCache.open(folder / "cache")

    @staticmethod
    def build(
        folder: Path, captions: Iterable[str], encoder: TextEncoder, vocabulary: Sequence[str],
        config: RewordConfig, progress: bool = True,
    ) -> Rewordings:  # fmt: skip
        """Reword and encode the captions; what is encoded already in `folder` is kept."""
        captions = sorted(set(captions))
        near = neighbours(captions, vocabulary, encoder, config)
        said = {c: [reword(c, near, number, config) for number in range(config.count)] for c in captions}
        build_with_encoder(folder / "cache", {t for texts in said.values() for t in texts}, encoder, progress)
        write_json(folder / _FILE, {"share": config.share, "neighbours": near, "captions": said})
        return Rewordings(folder)

    def of(self, captions: Sequence[str], draws: NDArray[np.float64]) -> list[str | None]:
        """What is read in each caption's place [B], by draws in [0, 1) [B]; None where it is the caption."""
        out: list[str | None] = []
        for caption, draw in zip(captions, draws.tolist(), strict=True):
            if caption not in self._said:
                raise UserError(
                    f"{self.folder}: no rewordings of '{caption[:80]}'; run the rewordings stage again"
                )
            choices = self._said[caption]
            out.append(choices[int(draw / self.share * len(choices))] if draw < self.share else None)
        return out

    def read(
        self, captions: Sequence[str], draws: NDArray[np.float64], text: TextCache
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32]]:
        """Tokens [B, S, E], their mask [B, S] and sentences [B, E] of captions or what is in their place."""
        said = self.of(captions, draws)
        tokens, mask = text.tokens(captions)
        sentence = text.sentence(captions)
        rows = [row for row, other in enumerate(said) if other is not None]
        others = [other for other in said if other is not None]
        if rows:
            new, shown = self.cache.tokens(others)
            wider = ((0, 0), (0, max(0, new.shape[1] - tokens.shape[1])))
            tokens, mask = np.pad(tokens, (*wider, (0, 0))), np.pad(mask, wider)
            tokens[rows], mask[rows] = 0.0, False
            tokens[rows, : new.shape[1]], mask[rows, : new.shape[1]] = new, shown
            sentence[rows] = self.cache.sentence(others)
        return tokens, mask, sentence

    def __getstate__(self) -> Path:
        return self.folder

    def __setstate__(self, folder: Path) -> None:
        Rewordings.__init__(self, folder)
