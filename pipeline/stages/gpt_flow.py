"""`GptFlow`: a GPT's tokens as they come, for streams (`contract/streaming.py`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from torch import Tensor

from motionloom.datasets.conditions import Conditions
from motionloom.models.gpt.drawing import as_codes
from motionloom.models.gpt.streaming import TokenStream


class GptFlow:
    """One motion's tokens, one group at a time.

    Args:
        tokens: The network's side.
        prior: First input of the GPT [1, E] of conditions of one row.
    """

    def __init__(self, tokens: TokenStream, prior: Callable[[Conditions], Tensor]) -> None:
        self._tokens, self._prior = tokens, prior

    def condition(self, conditions: Conditions) -> None:
        """The text of all that is drawn from now on."""
        self._tokens.condition(self._prior(conditions))

    def draw(self, left: int | None) -> Mapping[str, Tensor]:
        """One group."""
        group = self._tokens.draw()
        return as_codes(self._tokens.gpt, group[:, None], group.new_ones(1)).codes
