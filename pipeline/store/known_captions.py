"""Captions that a model was trained on, so that it can say which of a user's it does not know [ours].

A generator makes a motion of any caption. One that is far from all it was trained on, it makes of what it
happens to find near, and nothing in the motion says so. A few hundred training captions that stand for all of
them lie beside the encoder, with their sentence embeddings: no caption of the training set is far from one of
these. Embeddings are MiniLM's, which comes with the installation, whatever encoder the networks read.
"""

from __future__ import annotations

from collections.abc import Sequence
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

KNOWN_FILES = ("known.json", "known.safetensors")

COUNT = 384
"""Number of representative captions of each kind, of bodies and of faces."""

FAR = 0.45
"""Cosine below which a caption is far from another.

On synthetic captions 17 of 17 other wordings of what training says lie above it ("a guy greets you with his
right arm": 0.64) and 13 of 18 that are about something else below ("a person plays the violin": 0.35; but "a
person does a backflip": 0.48)."""


class _Texts(Config):
    """`known.json`."""

    body: tuple[str, ...]
    face: tuple[str, ...]


@dataclass(frozen=True)
class Unknown:
    """A caption that is far from all captions of the training."""

    caption: str
    nearest: tuple[str, ...]
    """Captions of the training, nearest first."""

    def __str__(self) -> str:
        known = "; ".join(f"'{text}'" for text in self.nearest)
        said = shorten(printable(self.caption), 100, placeholder=" …")
        return (
            f"'{said}' is unlike all captions that this model was trained on, so the motion may show "
            f"something else. The nearest it knows: {known}"
        )


@dataclass(frozen=True)
class KnownCaptions:
    """Captions of one kind and their unit-length embeddings [n, E]."""

    captions: tuple[str, ...]
    embeddings: NDArray[np.float32]

    def unknown(
        self, captions: Sequence[str], embeddings: NDArray[np.float32], count: int = 3
    ) -> list[Unknown]:
        """Those of `captions`, embeddings [m, E], that are far from all of these, in order, each once."""
        cosines = np.asarray(embeddings, dtype=np.float32) @ self.embeddings.T
        found: dict[str, Unknown] = {}
        for caption, row in zip(captions, cosines, strict=True):
            if len(row) and row.max() < FAR:
                nearest = np.argsort(-row, kind="stable")[:count]
                found.setdefault(caption, Unknown(caption, tuple(self.captions[k] for k in nearest)))
        return list(found.values())


def representatives(
    captions: Sequence[str], embeddings: NDArray[np.float32], count: int = COUNT
) -> KnownCaptions:
    """At most `count` of `captions`, embeddings [n, E], chosen so that none is far from a chosen one.

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
    return KnownCaptions(tuple(texts[k] for k in chosen), vectors[chosen])


def save_known(folder: Path, body: KnownCaptions, face: KnownCaptions) -> None:
    """Write both kinds into `folder`, embeddings in half precision."""
    kinds = {"body": body, "face": face}
    with atomic_path(folder / KNOWN_FILES[1]) as path:
        save_file({name: known.embeddings.astype(np.float16) for name, known in kinds.items()}, path)
    texts = _Texts(body=body.captions, face=face.captions)
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
        out[name] = KnownCaptions(captions, vectors.astype(np.float32))
    return out
