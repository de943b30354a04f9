"""Plan of batches whose rows come with different sets of modalities.

A clip's kind is the set of modalities that it comes with. `Balance` says how often each kind is drawn:
exactly its share of every epoch, spread evenly over the batches, as a pure function of (seed, k) like
`BatchPlan`, whose orders it uses. Batches mix the kinds, or are of one kind each (`homogeneous`).

In recipes a kind is the names joined by "+" ("text", "text+audio"), or "none".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.loading.order import shares
from motionloom.datasets.loading.plan import BatchPlan, Share
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.datasets.shards.clips import ClipDataset, Source

Kind = frozenset[str]
NONE = "none"


def kind_of(key: str) -> Kind:
    """The set of modalities that a key such as "text+audio" names."""
    kind = frozenset() if key == NONE else frozenset(part.strip() for part in key.split("+"))
    for name in sorted(kind - MODALITIES.keys()):
        raise ValueError(
            f"'{key}': no modality '{name}'; known: {', '.join(MODALITIES)}, joined by +, or none"
        )
    return kind


def key_of(kind: Kind) -> str:
    """Return a kind as recipes write it."""
    return "+".join(name for name in MODALITIES if name in kind) or NONE


def all_kinds(names: Sequence[str]) -> list[Kind]:
    """Every set of the modalities `names`: one alone, then two, ..., and none last."""
    some = [frozenset(kind) for size in range(1, len(names) + 1) for kind in combinations(names, size)]
    return [*some, frozenset()]


def _normal(weights: dict[str, float]) -> dict[str, float]:
    """Keys as `key_of` writes them, in the order of `all_kinds`."""
    by_kind = {kind_of(key): value for key, value in weights.items()}
    return {key_of(kind): by_kind[kind] for kind in all_kinds(list(MODALITIES)) if kind in by_kind}


def _weights(weights: dict[str, float]) -> dict[str, float]:
    if not any(weights.values()):
        raise ValueError("at least one kind of clips, such as text or text+audio, needs a weight above 0")
    return _normal(weights)


def _rates(rates: dict[str, float]) -> dict[str, float]:
    if sum(rates.values()) > 1:
        raise ValueError("the rates together are above 1: a row never loses everything")
    return _normal(rates)


Balance = Annotated[dict[str, Annotated[float, Field(ge=0)]], AfterValidator(_weights)]
"""Weights of the kinds of clips among the rows; kinds that are not named are never drawn."""

Drop = Annotated[dict[str, Annotated[float, Field(ge=0, le=1)]], AfterValidator(_rates)]
"""Rates of leaving sets of modalities out, by kind. A row never loses all that it has, nor two sets."""


def drop_some(
    drop: Mapping[str, float], present: NDArray[np.bool_], names: Sequence[str], draws: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return which modalities rows have after dropping, bool [B, M].

    Args:
        drop: Rates by kind.
        present: What they have, bool [B, M].
        names: The M modalities.
        draws: In [0, 1), [B].
    """
    out = present.copy()
    low = 0.0
    for key, rate in drop.items():
        kind = kind_of(key)
        left_out = np.array([name in kind for name in names])
        more = present[:, left_out].all(1) & present[:, ~left_out].any(1)
        out[np.ix_(more & (low <= draws) & (draws < low + rate), left_out)] = False
        low += rate
    return out


class KindPlan:
    """Clips of every global batch, by kind.

    Args:
        clips: Clips to draw from [n], ascending.
        present: What they come with, bool [n, M].
        names: The M modalities.
        balance: Weight of each kind; without it clips are drawn as they are, in the order that `BatchPlan`
            gives them alone.
    """

    def __init__(
        self,
        dataset: ClipDataset,
        clips: NDArray[np.int64],
        present: NDArray[np.bool_],
        names: Sequence[str],
        batch_size: int,
        seed: int,
        balance: Mapping[str, float] | None = None,
        homogeneous: bool = False,
    ) -> None:
        self.batch_size = batch_size
        groups = {
            key_of(kind): clips[(present == [name in kind for name in names]).all(1)]
            for kind in all_kinds(names)
        }
        weights = {kind: float(len(group)) for kind, group in groups.items()}
        if balance is not None:
            weights = {kind: balance.get(kind, 0.0) for kind in groups}
            for kind, weight in balance.items():
                if weight and not len(groups.get(kind, ())):
                    raise UserError(
                        f"{dataset.where}: balance.{kind} is {weight:g}, but no usable clip of split "
                        f"'{dataset.split}' comes with {kind} and nothing else; set it to 0 or change the "
                        f"data"
                    )
        used = [kind for kind in groups if weights[kind] > 0 and len(groups[kind])]
        self.clips = clips if balance is None else np.concatenate([groups[kind] for kind in used])
        self._whole: BatchPlan | None = None
        self._own: list[tuple[NDArray[np.int64], BatchPlan]] = []
        # Batches of one kind: each kind has a plan of its own, and the kinds take turns by their weights.
        if homogeneous:
            turns = []
            for kind in used:
                own = groups[kind]
                plan = BatchPlan(len(own), batch_size, seed, sources=dataset.sources(own))
                self._own.append((own, plan))
                turns.append(Source(0, len(own), weights[kind], name=f"balance.{kind}"))
            counts = shares(turns, max(1, len(self.clips) // batch_size))
            place = np.concatenate([(np.arange(count) + 0.5) / count for count in counts])
            order = np.argsort(place, kind="stable")
            self._kinds = np.repeat(np.arange(len(counts)), counts)[order]
            """Number of the kind of each batch of an epoch, the same for every rank."""
        else:
            sources: list[Source] = []
            if balance is None:
                sources = list(dataset.sources(clips))
            else:
                # Kinds are the sources of one plan; within a kind data sets of a mix keep their proportions.
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

    @property
    def ahead(self) -> int:
        """As `BatchPlan.ahead`."""
        return 1 if self._whole is None else self._whole.ahead

    def local(self, n: int, share: Share) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(turns, clips), [batch_size / world / parts]: the share's rows, as `BatchPlan.local`."""
        if self._whole is not None:
            turns, items = self._whole.local(n, share)
            return turns, self.clips[items]
        k, part = divmod(n, share.parts)
        epoch, position = divmod(k, len(self._kinds))
        of_kind = self._kinds == self._kinds[position]
        own, plan = self._own[self._kinds[position]]
        number = int(epoch * of_kind.sum() + of_kind[:position].sum())
        turns, items = plan.local(number * share.parts + part, share)
        return turns, own[items]
