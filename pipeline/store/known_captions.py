"""Representative training captions, used to flag captions that are unlike all of the training [ours].

A generator makes a motion of any caption, and nothing in the motion says that the caption was unlike all it
was trained on. So the text stage keeps some training captions that represent all, with their sentence
embeddings (MiniLM's, which comes with the installation, whatever encoder the networks read), and how far
validation captions are from the nearest of these. A new caption is unknown where it is farther than all but
`FALSE_ALARMS` of them.

TMA's text latents were tried in place of sentence embeddings: they put everyday captions of other actions as
near as those of the training (docs/results.md).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from textwrap import shorten

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import atomic_path, write_json
from motionloom.datasets.base.json_doors import require_plain

KNOWN_FILES = ("known.json", "known.safetensors")

FALSE_ALARMS = 0.01
"""Share of validation captions that are flagged."""

COUNT = 1024
"""Number of representative captions of each kind, of bodies and of faces. 384 of 48,834 captions lay too far
apart: of 100 motions that did as was said 21 had a note, with these 13."""

_ROUNDING = 1e-3
"""Cosine distance that a caption may have from itself: embeddings are kept in half precision. Where every
validation caption is a known one too, as of faces, the quantiles are no more than that."""
_QUANTILES = 101
_ENGLISH = (
    "a an and are at backward backwards both does forward forwards from he her his in is left not of "
    "on person right she someone the their then they to twice up while with without"
)
_OTHERS = (
    "alguien au aux avec com con dans de del dem den der des die donna du das een ein eine einem "
    "einen einer el elle em en et femme frau het hombre homem homme hun ihre il ist jemand la las le "
    "les lo los mann mit mujer na o os para persona personne persoon pessoa pour puis qualcuno quelqu "
    "que qui sa se seine su suo sur um uma un una unas und une uno uomo vers y zum zur"
)
"""Common words of Spanish, French, German, Italian, Portuguese and Dutch that captions of motions begin
with."""
_PIECES = 2.5
"""Tokens a word, above which a caption without a common English word is taken for another language's: of
1,213 English ones none was, of 43 in 20 languages 35 were."""
_SAMPLE = 20
"""Captions that say which language the training's are in."""
_NEAREST = 3
"""Captions of the training that are named beside an unknown one."""


class KnownText(Config):
    """Captions of one kind, in `known.json`."""

    captions: tuple[str, ...] = ()
    distances: tuple[float, ...] = ()
    """Quantiles, from 0 to 1 in even steps, of the cosine distance of a validation caption to the nearest."""


class KnownTexts(Config):
    """`known.json`."""

    body: KnownText
    face: KnownText
    actions: tuple[str, ...] = ()
    """The actions of the training's clips, where these state their truth."""


@dataclass(frozen=True)
class Unknown:
    """A caption that is far from all captions of the training."""

    caption: str
    nearest: tuple[str, ...] = ()
    """Captions of the training, nearest first."""
    english: bool = True
    """Whether it is in English, where the training's are."""

    @property
    def what(self) -> str:
        """The note for people, without the nearest captions."""
        from motionloom.datasets.base.printable import printable

        shown = shorten(printable(self.caption), 100, placeholder=" …")
        if not self.english:
            return f"this model reads English: of '{shown}' it may show anything"
        return (
            f"'{shown}' is unlike all captions that this model was trained on, so the motion may show "
            f"something else"
        )

    def __str__(self) -> str:
        known = "; ".join(f"'{text}'" for text in self.nearest)
        return f"{self.what}. The nearest it knows: {known}" if known else self.what


@dataclass(frozen=True)
class KnownCaptions:
    """Captions of one kind, their unit-length embeddings [n, E] and the distances of validation captions."""

    captions: tuple[str, ...]
    embeddings: NDArray[np.float32]
    distances: tuple[float, ...] = ()

    def is_far(self, embedding: NDArray[np.float32]) -> bool:
        """Whether a caption of this unit-length embedding [E] is unknown; none is where nothing is known."""
        if not self.captions or not self.distances:
            return False
        steps = np.linspace(0, 1, len(self.distances))
        limit = float(np.interp(1 - FALSE_ALARMS, steps, self.distances))
        return 1 - float((self.embeddings @ embedding).max()) > max(limit, _ROUNDING)

    def nearest(
        self, embedding: NDArray[np.float32], suits: Callable[[str], bool] = lambda _: True
    ) -> tuple[str, ...]:
        """Return those captions that suit and are nearest to an embedding [E], the nearest first."""
        order = np.argsort(-(self.embeddings @ embedding), kind="stable")
        return tuple(islice(filter(suits, (self.captions[k] for k in order)), _NEAREST))

    @property
    def english(self) -> bool:
        """Whether these captions are in English."""
        return is_english(" ".join(self.captions[:_SAMPLE]), 0)


def is_english(caption: str, pieces: int) -> bool:
    """Whether a caption may be English, judged by its commonest words.

    `pieces` is the number of tokens that MiniLM's English vocabulary cuts it into: words of other languages
    fall into many.
    """
    words = re.findall(r"[^\W_]+", caption.lower())
    if any(letter > "\u024f" for word in words for letter in word):  # beyond the Latin letters
        return False
    own = set(_ENGLISH.split()).intersection(words)
    others = {word for word in words if word in _OTHERS.split() or not word.isascii()}
    return len(others) <= len(own) and (bool(own) or len(words) < 2 or pieces <= _PIECES * len(words))


def representatives(
    captions: Sequence[str],
    embeddings: NDArray[np.float32],
    held_out: NDArray[np.float32],
    count: int = COUNT,
) -> KnownCaptions:
    """Return at most `count` of `captions`, embeddings [n, E], chosen so that none is far from a chosen one.

    The first is the one nearest to the mean, each next one the farthest from all before (Gonzalez 1985: at
    most twice as far as the best choice of as many). `held_out` [m, E] are embeddings of validation captions;
    where there are none, the training's own are measured.
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
        nearest[chosen[-1]] = np.inf  # never chosen twice
    known = vectors[chosen]
    measured = held_out if len(held_out) else vectors
    return KnownCaptions(tuple(texts[k] for k in chosen), known, distances_to(known, measured))


def distances_to(known: NDArray[np.float32], held_out: NDArray[np.float32]) -> tuple[float, ...]:
    """Return quantiles of the distance from embeddings [m, E] to the nearest of [n, E]."""
    nearest = 1 - (held_out @ known.T).max(axis=1)
    return tuple(np.quantile(nearest, np.linspace(0, 1, _QUANTILES)).round(4).tolist())


def save_known(folder: Path, body: KnownCaptions, face: KnownCaptions, actions: Sequence[str] = ()) -> None:
    """Write both kinds into `folder`, embeddings in half precision."""
    kinds = {"body": body, "face": face}
    with atomic_path(folder / KNOWN_FILES[1]) as path:
        save_file({name: known.embeddings.astype(np.float16) for name, known in kinds.items()}, path)
    texts = {
        name: KnownText(captions=known.captions, distances=known.distances) for name, known in kinds.items()
    }
    write_json(folder / KNOWN_FILES[0], KnownTexts(**texts, actions=tuple(sorted(actions))).dump())


def load_known(folder: Path) -> tuple[KnownTexts, dict[str, KnownCaptions]]:
    """Return the known texts of a folder, and "body" and "face" of them; empty without such files."""
    texts, embeddings = (folder / name for name in KNOWN_FILES)
    if not texts.is_file():
        return KnownTexts(body=KnownText(), face=KnownText()), {}
    found = KnownTexts.load_json(texts)
    try:
        require_plain(embeddings)
        arrays = load_file(embeddings)
    except (OSError, SafetensorError, TypeError, ValueError, AttributeError) as error:  # of odd types, sizes
        raise UserError(
            f"{embeddings}: cannot be read ({error}); delete it and {texts.name}, which only say what the "
            f"model knows, or copy the whole folder again"
        ) from None
    out = {}
    for name, own in (("body", found.body), ("face", found.face)):
        vectors = arrays.get(name)
        if vectors is None or vectors.ndim != 2 or len(vectors) != len(own.captions):
            raise UserError(
                f"{embeddings}: '{name}' does not go with {texts.name}; delete both, or copy them again"
            )
        out[name] = KnownCaptions(own.captions, vectors.astype(np.float32), own.distances)
    return found, out
