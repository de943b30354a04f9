"""How many rows of a batch come with text, with music, with both and with neither: the plan of such batches.

Clips fall into four kinds by what they come with. `Balance` says how often each kind is drawn: exactly its
share of every epoch, spread evenly over the batches, as a pure function of (seed, k) like `BatchPlan`, whose
orders it uses. Batches mix the kinds, or are of one kind each (`homogeneous`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from motionloom.datasets.loading.plan import BatchPlan
from motionloom.datasets.schema import Config, UserError
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.datasets.shards.order import Source, shares

Kind = Literal["text", "audio", "both", "none"]
KINDS: tuple[Kind, ...] = ("text", "audio", "both", "none")


class Balance(Config):
    """Shares of the kinds of clips among the rows, as weights; a kind of weight 0 is never drawn."""

    text: float = Field(0.0, ge=0)
    audio: float = Field(0.0, ge=0)
    both: float = Field(0.0, ge=0)
    none: float = Field(0.0, ge=0)

    @model_validator(mode="after")
    def _some(self) -> Balance:
        if not any(self.weights().values()):
            raise ValueError("at least one of text, audio, both and none needs a weight above 0")
        return self

    def weights(self) -> dict[Kind, float]:
        """Kind -> weight."""
        return {"text": self.text, "audio": self.audio, "both": self.both, "none": self.none}


class Drop(Config):
    """How often a clip that has both comes with one modality only: rates of leaving each of them out."""

    text: float = Field(0.0, ge=0, le=1)
    audio: float = Field(0.0, ge=0, le=1)

    @model_validator(mode="after")
    def _never_both(self) -> Drop:
        if self.text + self.audio > 1:
            raise ValueError("the rates of text and audio together are above 1: a row never loses both")
        return self

    def kinds(self, kinds: NDArray[np.int64], draws: NDArray[np.float64]) -> NDArray[np.int64]:
        """Kinds [B] (places in `KINDS`) after dropping by draws [B] in [0, 1)."""
        both = kinds == KINDS.index("both")
        out = np.where(both & (draws < self.text), KINDS.index("audio"), kinds)
        late = both & (draws >= self.text) & (draws < self.text + self.audio)
        return np.asarray(np.where(late, KINDS.index("text"), out), dtype=np.int64)


def kinds_of(text: NDArray[np.bool_], audio: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Place in `KINDS` of clips with text [n] and audio [n]."""
    return np.where(text & audio, 2, np.where(text, 0, np.where(audio, 1, 3))).astype(np.int64)


class KindPlan:
    """Which clips every global batch holds. `clips` [n] ascending, `kinds` [n] their kinds.

    Without a balance clips are drawn as they are, in the order that `BatchPlan` gives them alone.
    """

    def __init__(
        self,
        dataset: ClipDataset,
        clips: NDArray[np.int64],
        kinds: NDArray[np.int64],
        batch_size: int,
        seed: int,
        balance: Balance | None = None,
        homogeneous: bool = False,
    ) -> None:
        self.batch_size = batch_size
        groups = {kind: clips[kinds == place] for place, kind in enumerate(KINDS)}
        weights: Mapping[Kind, float] = {kind: float(len(group)) for kind, group in groups.items()}
        if balance is not None:
            weights = balance.weights()
            for kind, weight in weights.items():
                if weight and not len(groups[kind]):
                    raise UserError(
                        f"{dataset.where}: balance.{kind} is {weight:g}, but no usable clip of split "
                        f"'{dataset.split}' comes with {_MEANING[kind]}; set it to 0 or change the data"
                    )
        used: list[Kind] = [kind for kind in KINDS if weights[kind] > 0 and len(groups[kind])]
        self.clips = clips if balance is None else np.concatenate([groups[kind] for kind in used])
        self._whole: BatchPlan | None = None
        self._own: list[tuple[NDArray[np.int64], BatchPlan]] = []
        self._turns: list[Source] = []
        if homogeneous:
            for kind in used:
                own = groups[kind]
                plan = BatchPlan(len(own), batch_size, seed, sources=dataset.sources(own))
                self._own.append((own, plan))
                self._turns.append(Source(0, len(own), weights[kind], name=f"balance.{kind}"))
            self._epoch = max(1, len(self.clips) // batch_size)
            self._shares = shares(self._turns, self._epoch)
        else:
            sources: list[Source] = []
            if balance is None:
                sources = list(dataset.sources(clips))
            else:
                for kind in used:
                    first = sum(source.count for source in sources)
                    inner = dataset.sources(groups[kind])
                    total = sum(source.weight for source in inner)
                    sources += [
                        replace(
                            source,
                            first=first + source.first,
                            weight=weights[kind] * source.weight / total,
                            name=source.name or f"balance.{kind}",
                        )
                        for source in inner
                    ]
            self._whole = BatchPlan(len(self.clips), batch_size, seed, sources=sources)

    def local(self, k: int, rank: int, world: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(turns, clips), [batch_size / world]: the rank's rows of global batch `k`, as `BatchPlan.local`."""
        if self._whole is not None:
            turns, items = self._whole.local(k, rank, world)
            return turns, self.clips[items]
        epoch, position = divmod(k, self._epoch)
        place = np.concatenate([(np.arange(share) + 0.5) / share for share in self._shares])
        which = np.repeat(np.arange(len(self._shares)), self._shares)[np.argsort(place, kind="stable")]
        kind = int(which[position])
        own, plan = self._own[kind]
        number = epoch * self._shares[kind] + int((which[:position] == kind).sum())
        turns, items = plan.local(number, rank, world)
        return turns, own[items]


_MEANING: dict[Kind, str] = {
    "text": "text alone",
    "audio": "music alone",
    "both": "text and music",
    "none": "neither text nor music",
}
