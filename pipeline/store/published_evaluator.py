"""The published evaluator of Guo et al. in a folder that its user made of the release.

| file | content |
|---|---|
| `evaluator.json` | layout that it judges, and the sha256 of each of the other files |
| `model.safetensors` | the release's tensors by their names there, `movement_encoder.main.0.weight` ... |
| `stats.safetensors` | `mean` and `std` [D] that its motions are normalised by |
| `words.safetensors` | `vectors` [n, 300] of its words |
| `words.json` | the words, the names of the word classes, and lists of words that have a class of their own |

`docs/guo_evaluator.py` makes such a folder. Nothing in it is pickled, and every file is checked before use.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.evaluator.network import Evaluator, EvaluatorConfig
from motionloom.pipeline.store.evaluator import LoadedEvaluator, Words
from motionloom.pipeline.store.weights import Release, exact_tensors

FACTS, MODEL, STATS, VECTORS, WORDS = (
    "evaluator.json", "model.safetensors", "stats.safetensors", "words.safetensors", "words.json",
)  # fmt: skip
FILES = (MODEL, STATS, VECTORS, WORDS)

MAX_FRAMES = 196
MAX_WORDS = 20
"""Words of a caption behind these are not read."""

_FIRST = "sos"
_LAST = "eos"
_UNKNOWN = "unk"
_OTHER = "OTHER"
"""The class of words that have none."""

_MAKE = "make the folder again by docs/guo_evaluator.py"

_SEQUENCE = {"input_emb": "project", "output_net.0": "narrow", "output_net.1": "norm", "output_net.3": "out"}
_MOVEMENT = {"main.0": "first", "main.3": "second", "out_net": "out"}


class PublishedFacts(Config):
    """`evaluator.json`."""

    version: Literal[1]
    layout: Literal["h3d263"]
    sha256: dict[str, str]
    """Checksums of every other file."""


class PublishedVocabulary(Config):
    """`words.json`."""

    words: list[str]
    """In the order of `vectors`."""
    classes: list[str]
    """Names of the word classes, in the order of the one-hot vector."""
    lists: dict[str, list[str]]
    """Class -> words that belong to it whatever their tag says; the first list that has a word counts."""


@dataclass(frozen=True)
class PublishedWords:
    """Word vectors and classes, as the published code looks them up."""

    vectors: Tensor
    """[n, E]"""
    vocabulary: PublishedVocabulary

    @cached_property
    def rows(self) -> Mapping[str, int]:
        return {word: row for row, word in enumerate(self.vocabulary.words)}

    @cached_property
    def own_class(self) -> Mapping[str, str]:
        out: dict[str, str] = {}
        for name, words in self.vocabulary.lists.items():
            for word in words:
                out.setdefault(word, name)
        return out

    def read(self, captions: Sequence[str], tokens: Sequence[Sequence[str]]) -> Words:
        """At most `MAX_WORDS` words of each caption, between the marks of its beginning and its end."""
        rows = [self._caption(*both) for both in zip(captions, tokens, strict=True)]
        places = max(len(row) for row in rows)
        features = torch.zeros(len(rows), places, self.vectors.shape[1])
        classes = torch.zeros(len(rows), places, len(self.vocabulary.classes))
        for number, row in enumerate(rows):
            for place, (word, kind) in enumerate(row):
                features[number, place] = self.vectors[word]
                classes[number, place, kind] = 1.0
        length = torch.tensor([len(row) for row in rows])
        return Words(features, torch.arange(places)[None] < length[:, None], classes)

    def _caption(self, caption: str, tokens: Sequence[str]) -> list[tuple[int, int]]:
        """Row of `vectors` and class of each word."""
        if not tokens:
            raise UserError(
                f"caption '{caption[:80]}' has no word/POS tags, which the published evaluator reads; judge "
                f"data that bring them (HumanML3D), or train an evaluator on yours (kind: evaluator)"
            )
        framed = [f"{_FIRST}/{_OTHER}", *tokens[:MAX_WORDS], f"{_LAST}/{_OTHER}"]
        return [self._word(*token.rpartition("/")[::2]) for token in framed]

    def _word(self, word: str, tag: str) -> tuple[int, int]:
        names = self.vocabulary.classes
        if word not in self.rows:
            return self.rows[_UNKNOWN], names.index(_OTHER)
        kind = self.own_class.get(word, tag)
        return self.rows[word], names.index(kind if kind in names else _OTHER)


def load_published(folder: Path, device: torch.device | None = None) -> LoadedEvaluator:
    """The evaluator of a folder, every file checked; a `UserError` of one sentence names what is wrong."""
    facts = check_published(folder)
    layout = MotionLayout.named(facts.layout)
    vocabulary = _vocabulary(folder / WORDS)
    vectors = exact_tensors(folder / VECTORS, {"vectors": (len(vocabulary.words), _WIDTH)}, _MAKE)["vectors"]
    stats = exact_tensors(folder / STATS, {"mean": (layout.dim,), "std": (layout.dim,)}, _MAKE)
    if not (stats["std"] > 0).all():
        raise UserError(f"{folder / STATS}: std has columns that are not above 0; {_MAKE}")
    # The published deviations hold the gain of the root already.
    config = EvaluatorConfig(root_gain=1.0)
    net = Evaluator(config, layout, _WIDTH, MAX_FRAMES, classes=len(vocabulary.classes))
    Release(published_names(net), fix=_MAKE).fill(folder / MODEL, net)
    return LoadedEvaluator(
        net.to(device or torch.device("cpu")).eval().requires_grad_(False),
        layout,
        FeatureStats(stats["mean"].numpy(), stats["std"].numpy(), layout),
        PublishedWords(vectors, vocabulary),
    )


_WIDTH = 300
"""Width of the word vectors."""


def check_published(folder: Path) -> PublishedFacts:
    """Return a folder's description, after comparing its checksums."""
    if not folder.is_dir():
        raise UserError(
            f"{folder}: no such folder (the published evaluator); make it by docs/guo_evaluator.py"
        )
    facts = PublishedFacts.load_json(folder / FACTS)
    for name in FILES:
        if name not in facts.sha256:
            raise UserError(f"{folder / FACTS}: key 'sha256.{name}' is required; {_MAKE}")
        if not (folder / name).is_file():
            raise UserError(f"{folder / name}: no such file; {_MAKE}")
        if sha256_of(folder / name) != facts.sha256[name]:
            raise UserError(f"{folder / name}: not the file whose sha256 {FACTS} names; {_MAKE}")
    return facts


def published_names(net: Evaluator) -> dict[str, str]:
    """Names of the network's tensors -> their names in the release.

    A GRU's two first states lie in one tensor there, as here, and its directions differ by a suffix.
    """
    return {name: _published_name(name) for name in net.state_dict()}


def _published_name(name: str) -> str:
    encoder, _, rest = name.partition(".")
    if encoder == "class_embedding":
        return f"text_encoder.pos_emb.{rest}"
    if rest == "start":
        return f"{encoder}.hidden"
    layer, _, kind = rest.rpartition(".")
    if layer in ("ahead", "back"):
        return f"{encoder}.gru.{kind}{'_reverse' if layer == 'back' else ''}"
    known = _MOVEMENT if encoder == "movement_encoder" else _SEQUENCE
    return f"{encoder}.{ {own: published for published, own in known.items()}[layer] }.{kind}"


def _vocabulary(path: Path) -> PublishedVocabulary:
    found = PublishedVocabulary.load_json(path)
    lacking = [word for word in (_FIRST, _LAST, _UNKNOWN) if word not in found.words]
    if lacking:
        raise UserError(f"{path}: key 'words' lacks '{lacking[0]}'; {_MAKE}")
    unnamed = [name for name in (_OTHER, *found.lists) if name not in found.classes]
    if unnamed:
        raise UserError(f"{path}: key 'classes' lacks '{unnamed[0]}'; {_MAKE}")
    return found
