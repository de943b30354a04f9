"""Captions that a model was trained on, so that it can say which of a user's it does not know [ours].

A generator makes a motion of any caption. One that is far from all it was trained on, it makes of what it
happens to find near, and nothing in the motion says so. Some training captions that stand for all of them lie
beside the encoder, with their sentence embeddings: no caption of the training set is far from one of these.
Embeddings are MiniLM's, which comes with the installation, whatever encoder the networks read.

A caption is known if it has no word that training had nothing like, and if a caption of the training is near
it, both as a sentence and as the model itself reads the two, and has the words that decide by themselves.
Where it is very near, other words that training had nothing like change nothing.

Where it is known what the motions of these captions do, as of synthetic clips, the nearest say what a new one
asks for, and its motion can be compared with that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from motionloom.datasets.base.files import atomic_path, write_json
from motionloom.datasets.base.printable import printable
from motionloom.datasets.schema import Config, UserError
from motionloom.datasets.synth.actions.truth import ACTIONS
from motionloom.datasets.text.said import Acts, acts_said, meant_by
from motionloom.datasets.text.words import (
    Encode,
    HeardWords,
    decides,
    deciding,
    in_turn,
    taken_back,
    words_of,
)

KNOWN_FILES = ("known.json", "known.safetensors")

COUNT = 1024
"""Number of representative captions of each kind, of bodies and of faces. 384 of 48,834 captions lay too far
apart: of 100 motions that did as was said 21 had a note, with these 13; of 100 that did not, 75 with both."""

FAR = 0.5
"""Cosine of sentence embeddings below which a caption is far from another, where nothing else is known; like
`NEAR` chosen on the development part of `benchmarks/known_words.yaml`."""

NEAR = 1.2
"""Sum of that cosine and of the cosine of the model's own readings from which a caption is near another."""
BESIDE = 1.05
"""The same for a caption that has a word that decides: it may have other hands."""

NEAREST, AT_ONCE = 128, 32
"""Known captions that the model reads beside a new one at most, and how many at a time."""

SURE = 1.4
"""The same from which words that were never heard change nothing, unless they decide."""
OTHERWISE = 0.1
"""By how much a caption may be nearer, as a sentence, to an action that is none of the training's
(`OTHER_ACTIONS`)."""
LIKE_IT, AS_NEAR = 3, 0.05
"""Known captions whose motions say what a new one may ask for, at most, and by how much less near than the
nearest; chosen on the same sentences."""


class _Texts(Config):
    """`known.json`."""

    body: tuple[str, ...]
    face: tuple[str, ...]
    words: tuple[str, ...] = ()
    acts: tuple[Acts, ...] = ()
    """What the motions of the body's captions do, in their order."""


@dataclass(frozen=True)
class Unknown:
    """A caption that is far from all captions of the training, or that is read as another."""

    caption: str
    nearest: tuple[str, ...]
    """Captions of the training, nearest first."""
    read_as: str = ""
    """Where only its spelling is unknown: what it is taken for; `nearest` is empty."""

    @property
    def what(self) -> str:
        """What there is to say of the caption, without the nearest ones."""
        if self.read_as:
            return f"'{printable(self.caption)}' is read as '{printable(self.read_as)}'"
        said = shorten(printable(self.caption), 100, placeholder=" …")
        return (
            f"'{said}' is unlike all captions that this model was trained on, so the motion may show "
            f"something else"
        )

    def __str__(self) -> str:
        known = "; ".join(f"'{text}'" for text in self.nearest)
        return f"{self.what}. The nearest it knows: {known}" if known else self.what


@dataclass(frozen=True)
class KnownCaptions:
    """Captions of one kind and their unit-length embeddings [n, E]."""

    captions: tuple[str, ...]
    embeddings: NDArray[np.float32]
    words: frozenset[str] = frozenset()
    """All words of the training's captions; empty where they were not kept."""
    acts: tuple[Acts, ...] = ()
    """What the motion of each caption does; empty where that is not known."""

    def asked(self, caption: str, encode: Encode, read: Encode | None = None) -> list[Acts]:
        """What a caption may ask for, likeliest first: what the motions of those captions do that are about
        as near to it as the nearest. One that puts an action after another is looked at part by part.
        """
        if not self.acts:
            return []
        said = self.said(caption)
        if said:
            return meant_by(caption, said) if _known(said) else []
        parts = in_turn(caption)
        if len(parts) != 2:
            return self._asked(caption, range(len(self.acts)), encode, read)
        alone = [k for k, acts in enumerate(self.acts) if len(acts) == 1]
        if not alone:
            return []
        first, second = (self._asked(part, alone, encode, read) for part in parts)
        return [one + other for one in first for other in second]

    def said(self, caption: str) -> Acts:
        """What a caption asks for by its words, if the training has that; else empty."""
        done = {act for acts in self.acts for act in acts}
        parts = [acts_said(part) for part in in_turn(caption)]
        acts = tuple(act for part in parts for act in part)
        plain = len(parts) == 1 or all(len(part) == 1 for part in parts)
        return acts if plain and done.issuperset(acts) else ()

    def _asked(self, caption: str, among: Sequence[int], encode: Encode, read: Encode | None) -> list[Acts]:
        nearest, near = self._nearest(caption, among, encode, read)
        order = np.argsort(-near, kind="stable")[:LIKE_IT]
        found = [self.acts[among[nearest[k]]] for k in order if near[k] >= near[order[0]] - AS_NEAR]
        return list(dict.fromkeys(found)) if all(found) else []

    def _nearest(
        self, caption: str, among: Sequence[int], encode: Encode, read: Encode | None
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Of `among` those nearest as sentences, and how near they are, with the model's reading."""
        near = self.embeddings[among] @ np.asarray(encode([caption]), np.float32)[0]
        nearest = np.argsort(-near, kind="stable")[:AT_ONCE]
        near = near[nearest]
        if read is not None:
            readings = read([caption, *(self.captions[among[k]] for k in nearest)])
            near = near + readings[1:] @ readings[0]
        return nearest, near

    def _otherwise(self, caption: str, said: Acts, heard: HeardWords) -> bool:
        """Whether a caption, even if it names actions of the training, asks for something else: it takes them
        back, does too much, or is nearer to another action.
        """
        if not self.acts:
            return False
        if not _known(said) or (said and taken_back(caption)):
            return True
        same = [k for k, acts in enumerate(self.acts) if not said or set(acts) <= set(said)]
        vector = np.asarray(heard.encode([caption]), np.float32)[0]
        return bool((self.embeddings[same] @ vector).max() < (heard.others @ vector).max() - OTHERWISE)

    def unknown(
        self, captions: Sequence[str], heard: HeardWords, read: Encode | None = None, count: int = 3
    ) -> list[Unknown]:
        """Those of `captions` that are not known, in order, each once.

        Args:
            captions: What was said.
            heard: The words of the training, with the embeddings of these captions.
            read: The model's own unit-length readings of captions; without, sentences alone decide.
            count: How many of the nearest to name.
        """
        if not self.captions:
            return []
        found = dict[str, Unknown]()
        meant = [heard.spelt(caption) for caption in captions]
        cosines = np.asarray(heard.encode(meant), dtype=np.float32) @ self.embeddings.T
        for said, caption, row in zip(captions, meant, cosines, strict=True):
            order = np.argsort(-row, kind="stable")
            named = self.said(caption)
            known = not self._otherwise(caption, named, heard) and (
                bool(named) or self._near(caption, order, row, heard, read)
            )
            if not known:
                found.setdefault(said, Unknown(said, tuple(self.captions[k] for k in order[:count])))
            elif caption != said:
                found.setdefault(said, Unknown(said, (), caption))
        return list(found.values())

    def _near(
        self,
        caption: str,
        order: NDArray[np.int64],
        row: NDArray[np.float32],
        heard: HeardWords,
        read: Encode | None,
    ) -> bool:
        """Whether a caption of the training is near one, `row` [n] as sentences, and those together that do
        what it asks for have its words that decide. Without a reading, from `FAR` on one is near.
        """
        strange = heard.unheard(caption)
        if any(map(decides, strange)):
            return False
        enough = SURE if strange else NEAR
        asked = {act for acts in self.asked(caption, heard.encode, read) for act in acts}
        missing, found = set(deciding(caption)), False
        for first in range(0, min(NEAREST, len(order)), AT_ONCE):
            block = order[first : first + AT_ONCE]
            texts = [self.captions[k] for k in block]
            if read is None:
                near = np.where(row[block] >= FAR, NEAR, 0.0)
            else:
                readings = read([caption, *texts])
                near = row[block] + readings[1:] @ readings[0]
            found = found or bool((near >= enough).any())
            for k, text, nearness in zip(block, texts, near, strict=True):
                if nearness >= BESIDE and (not asked or not asked.isdisjoint(self.acts[k])):
                    missing.difference_update(deciding(text))
            if found and not missing:
                return True
        return False


def _known(acts: Acts) -> bool:
    """Whether acts are nothing, an action, or two in turn."""
    return len(acts) <= 2 and not set(acts) - set(ACTIONS)


def representatives(
    captions: Sequence[str],
    embeddings: NDArray[np.float32],
    count: int = COUNT,
    acts: Mapping[str, Acts] | None = None,
) -> KnownCaptions:
    """At most `count` of `captions`, embeddings [n, E], chosen so that none is far from a chosen one; `acts`
    is what the motions of all captions do, where it is known.

    The first is the one nearest to the mean, each next one the farthest from all before (Gonzalez 1985: at
    most twice as far as the best choice of as many).
    """
    order = sorted(range(len(captions)), key=lambda k: captions[k])
    texts = [captions[k] for k in order]
    vectors = np.asarray(embeddings, dtype=np.float32)[order]
    if not texts:
        return KnownCaptions((), vectors.reshape(0, vectors.shape[-1]))
    chosen = [int((vectors @ vectors.mean(axis=0)).argmax())]
    nearest = vectors @ vectors[chosen[0]]
    while len(chosen) < min(count, len(texts)):
        chosen.append(int(nearest.argmin()))
        nearest = np.maximum(nearest, vectors @ vectors[chosen[-1]])
        nearest[chosen[-1]] = np.inf
    known = tuple(texts[k] for k in chosen)
    done = tuple(acts.get(text, ()) for text in known) if acts else ()
    return KnownCaptions(known, vectors[chosen], words_of(texts), done if any(done) else ())


def save_known(folder: Path, body: KnownCaptions, face: KnownCaptions) -> None:
    """Write both kinds into `folder`, embeddings in half precision."""
    kinds = {"body": body, "face": face}
    with atomic_path(folder / KNOWN_FILES[1]) as path:
        save_file({name: known.embeddings.astype(np.float16) for name, known in kinds.items()}, path)
    words = tuple(sorted(body.words))
    texts = _Texts(body=body.captions, face=face.captions, words=words, acts=body.acts)
    write_json(folder / KNOWN_FILES[0], texts.dump())


def load_known(folder: Path) -> dict[str, KnownCaptions]:
    """Both kinds by name, "body" and "face"; none where `folder` has no such files."""
    texts, embeddings = (folder / name for name in KNOWN_FILES)
    if not texts.is_file():
        return {}
    said = _Texts.load_json(texts)
    try:
        found = load_file(embeddings)
    except (OSError, SafetensorError) as error:
        raise UserError(
            f"{embeddings}: cannot be read ({error}); delete it and {texts.name}, which only say what the "
            f"model knows, or copy the whole folder again"
        ) from None
    out = {}
    for name, captions in (("body", said.body), ("face", said.face)):
        vectors = found.get(name)
        if vectors is None or vectors.ndim != 2 or len(vectors) != len(captions):
            raise UserError(
                f"{embeddings}: '{name}' does not go with {texts.name}; delete both, or copy them again"
            )
        words, acts = (frozenset(said.words), said.acts) if name == "body" else (frozenset(), ())
        if acts and (len(acts) != len(captions) or not all(map(_known, acts))):
            raise UserError(f"{texts}: acts does not go with body; delete it, or copy the file again")
        out[name] = KnownCaptions(captions, vectors.astype(np.float32), words, acts)
    return out
