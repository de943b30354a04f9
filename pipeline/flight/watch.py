"""The figures and gradients of the latest steps, and the first of them that was not finite.

Nothing is read from a GPU within a row of the log: what a step gives is kept where it is (a few numbers) and
read at the row's end, where the log waits for the device anyway. On a CPU reading costs nothing, so there the
layer groups of the very step that fails are known; later steps have spread it over all of them.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.distributed.tensor import DTensor

from motionloom.models.training.players import PlayersModule
from motionloom.models.training.stage_module import LOG_EVERY, StageModule
from motionloom.pipeline.flight.groups import LayerGroups, read_norms, whole


@dataclass(frozen=True)
class Failure:
    """The first step whose loss or gradient was not finite."""

    step: int
    """Counted as the log does: the first step of a training is 1."""
    loss: bool
    """False: of this process the loss was finite and the gradient, the mean over all, was not."""
    terms: dict[str, float] = field(default_factory=dict)
    """Figures that were not finite."""
    groups: tuple[str, ...] = ()
    """Layer groups whose gradients were not, where that is known."""

    @property
    def code(self) -> float:
        """Orders the failures of several processes: the earliest, and of one step a loss before gradients."""
        return 2.0 * self.step + (0.0 if self.loss else 1.0)

    def say(self) -> str:
        """What was not finite, in words."""
        said = "the loss is" if self.loss else "the gradient is"
        more = [", ".join(f"{name} = {value}" for name, value in self.terms.items())]
        if self.groups:
            more.append(f"gradients of {', '.join(self.groups)}")
        details = "; ".join(part for part in more if part)
        return f"{said} not finite" + (f" ({details})" if details else "")


class Watch:
    """Looks on at a module's steps (`Watcher`). `keep` steps are remembered with their figures."""

    def __init__(self, module: StageModule, *, keep: int, scaled: bool) -> None:
        self.module, self.scaled = module, scaled
        """`scaled`: a gradient scaler passes over steps whose gradients overflow; they are no failure."""
        self.groups = LayerGroups(module)
        self.recent: deque[tuple[int, dict[str, list[float]]]] = deque(maxlen=keep)
        """(step, figures of each of its parts), of steps that have been collected."""
        self._norms: dict[int, tuple[int, dict[str, Tensor]]] = {}
        players = module.players() if isinstance(module, PlayersModule) else ()
        self._players = {id(player.params()[0]): player for player in players}
        self._figures: list[tuple[int, tuple[str, ...], Tensor]] = []
        self._totals: list[tuple[int, Tensor]] = []
        self._broken: dict[str, Tensor] | None = None

    def figures(self, names: tuple[str, ...], values: Tensor) -> None:
        """Keep them."""
        self._figures.append((self.module.global_step + 1, names, values))

    def gradients(self, params: Sequence[nn.Parameter], norm: Tensor | None) -> None:
        """Keep the norm, and those of the layer groups at a row's end and where something fails."""
        step = self.module.global_step + 1
        if norm is not None:
            self._totals.append((step, norm))
        # Reading what is cut over ranks is a collective, and one rank may see a failure alone.
        cut = bool(params) and isinstance(params[0], DTensor)
        fails = self._broken is None and not cut and self._fails(step, norm)
        who = id(params[0]) if params else 0
        if fails or self._last_of_row(who):
            found = self.groups.gradient_norms(params)
            self._norms[who] = step, found
            if fails:
                self._broken = found

    def _last_of_row(self, who: int) -> bool:
        """Whether these parameters are stepped for the last time in this row of the log."""
        player, step = self._players.get(who), self.module.global_step
        if player is None:
            return self.module.ends_row
        return not any(player.plays(later) for later in range(step + 1, step - step % LOG_EVERY + LOG_EVERY))

    @property
    def norms(self) -> dict[str, Tensor]:
        """Gradient norms by layer group, each of its last step in the row of the log that has just ended."""
        since = self.module.global_step - LOG_EVERY
        recent = [own for step, own in self._norms.values() if step > since]
        return {name: norm for own in recent for name, norm in own.items()}

    def collect(self) -> Failure | None:
        """Read what was kept; the first failure in it. Every process calls this at the same step."""
        totals, self._totals = self._totals, []
        losses = self.read()
        failure = next(iter(sorted(losses, key=lambda found: found.step)), None)
        if totals and not self.scaled:
            values = torch.stack([whole(norm).float() for _, norm in totals]).tolist()
            step = next((s for (s, _), v in zip(totals, values, strict=True) if not math.isfinite(v)), None)
            if step is not None and (failure is None or step < failure.step):
                failure = Failure(step, loss=False)
        if failure is None or self._broken is None:
            return failure
        bad = tuple(name for name, norm in read_norms(self._broken).items() if not math.isfinite(norm))
        return Failure(failure.step, failure.loss, failure.terms, bad)

    def read(self) -> list[Failure]:
        """Move the figures that were kept into `recent`; the steps whose loss was not finite."""
        kept, self._figures = self._figures, []
        names = dict.fromkeys(own for _, own, _ in kept)
        read = {own: iter(torch.stack([v for _, n, v in kept if n == own]).tolist()) for own in names}
        steps: dict[int, dict[str, list[float]]] = {}
        for step, own, _ in kept:
            figures = steps.setdefault(step, {})
            for name, value in zip(own, next(read[own]), strict=True):
                figures.setdefault(name, []).append(value)
        self.recent.extend(steps.items())
        return [f for step, figures in steps.items() if (f := failure_of(step, figures)) is not None]

    def _fails(self, step: int, norm: Tensor | None) -> bool:
        """Whether this step has failed, where that can be seen without waiting."""
        if self.module.device.type != "cpu":
            return False
        if norm is not None and not self.scaled and not math.isfinite(float(norm)):
            return True
        for at, names, values in reversed(self._figures):
            if at != step:
                return False
            losses = zip(names, values.tolist(), strict=True)
            if not all(math.isfinite(value) for name, value in losses if is_loss(name)):
                return True
        return False


def is_loss(name: str) -> bool:
    """Whether a figure is a loss that is minimised: a stage's own, or a player's."""
    return name == "loss" or name.endswith("_loss")


def failure_of(step: int, figures: dict[str, list[float]]) -> Failure | None:
    """Whether a step's losses were finite; every figure that was not is named, the terms of a loss first."""
    bad = {name: own for name, own in figures.items() if not all(map(math.isfinite, own))}
    if not any(is_loss(name) for name in bad):
        return None
    terms = {name: next(v for v in own if not math.isfinite(v)) for name, own in bad.items()}
    return Failure(step, loss=True, terms=dict(sorted(terms.items(), key=lambda item: is_loss(item[0]))))
