"""What a GPT must have in common with its TMA, and with a GPT that it starts from."""

from __future__ import annotations

from collections.abc import Mapping

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.stage import Stage
from motionloom.pipeline.stages.same_text import same_encoder
from motionloom.pipeline.stages.starting import START, starts_from
from motionloom.pipeline.store.outside import is_place

_SIZES = ("layers", "dim", "heads", "ff", "block_size")
"""Of the network; a GPT goes on from another only where these are equal."""


def require_own_text(stage: Stage, others: Mapping[str, Stage]) -> None:
    """A TMA must be given captions by the encoder that it was trained on."""
    tma, own = others.get(stage.inputs.get("tma", "")), stage.inputs.get("text", "")
    other = tma.inputs.get("text", "") if tma is not None else own
    if not same_encoder(own, other, others):
        raise UserError(
            f"stage '{stage.name}' reads captions as '{own}' encodes them, but its TMA "
            f"'{stage.inputs['tma']}' was trained on those of '{other}'; name one text stage for both, "
            f"or leave the TMA out (inputs: {{tma: null}})"
        )


def _its_own(start: Stage, wrong: list[str]) -> str:
    """Where the inputs of a GPT outside the run lie, for the message."""
    roles = [name.removeprefix("inputs.") for name in wrong if name.startswith("inputs.")]
    there = [f"{role}: {start.inputs[role]}" for role in roles if is_place(start.inputs.get(role, ""))]
    return f", like inputs: {{{', '.join(there)}}}" if there else ""


def require_start(stage: Stage, others: Mapping[str, Stage]) -> None:
    """A GPT can go on from another's weights where both are one network that reads and writes the same."""
    if stage.config.lora is not None and START not in stage.inputs:
        raise UserError(
            f"stage '{stage.name}' has lora and no trained GPT to add adapters to; name one in "
            f"stages.{stage.name}.inputs.{START}, or set lora: null"
        )
    start = others.get(stage.inputs.get(START, ""))
    if start is None:
        return
    ours, theirs = stage.config, start.config
    wrong = [f"net.{size}" for size in _SIZES if getattr(ours.net, size) != getattr(theirs.net, size)]
    wrong += ["prior"] if ours.prior != theirs.prior else []
    roles = ("tokenizer",) + (("tma",) if ours.prior == "tma" else ())
    if not same_encoder(start.inputs.get("text", ""), stage.inputs.get("text", ""), others):
        wrong.append("inputs.text")
    for role in roles:
        # A tokenizer or TMA that was itself trained on from the start's speaks nearly the same language.
        own, theirs_is = stage.inputs.get(role, ""), start.inputs.get(role, "")
        wrong += [] if starts_from(own, theirs_is, others) else [f"inputs.{role}"]
    if wrong:
        raise UserError(
            f"stage '{stage.name}' starts from '{start.name}', which differs in {', '.join(wrong)}; give "
            f"both the same{_its_own(start, wrong)}"
        )
