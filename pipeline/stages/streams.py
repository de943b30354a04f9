"""The code streams that a network was made for, and those of the tokenizer it is given."""

from __future__ import annotations

from typing import Any

from motionloom.datasets.schema import UserError
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.pipeline.store.weights import ModelFacts


def stream_facts(tokenizer: Tokenizer) -> dict[str, Any]:
    """What a network over a tokenizer's codes writes down: `streams` (codes by name) and `pattern`."""
    return {
        "streams": {stream.name: stream.num_codes for stream in tokenizer.streams},
        "pattern": list(tokenizer.pattern),
    }


def require_streams(facts: ModelFacts, tokenizer: Tokenizer, what: str) -> None:
    """`UserError` unless the tokenizer has the streams and the pattern that the network was trained on."""
    here = stream_facts(tokenizer)
    streams, pattern = facts.fact("streams", dict), facts.fact("pattern", list)
    if (streams, pattern) != (here["streams"], here["pattern"]):
        raise UserError(
            f"{facts.where}: this {what} was trained on streams {streams} in the order {pattern}, the "
            f"tokenizer has {here['streams']} in the order {here['pattern']}; train it again on this one"
        )
