"""Trainings that start from another network of their kind, and the checks that both fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from pathlib import Path

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.layout import MotionLayout, require_layout
from motionloom.pipeline.contract.stage import CPU, Stage
from motionloom.pipeline.store.run_folder import in_export, is_place
from motionloom.pipeline.store.text import TextSource

START = "start"
"""The role of the network that a training starts from."""


def starts_from(name: str, first: str, others: Mapping[str, Stage]) -> bool:
    """Whether a stage is `first` or was trained from it, directly or through others; "" is no stage."""
    if not first:
        return not name
    visited: set[str] = set()
    while name not in visited:
        if name == first:
            return True
        visited.add(name)
        name = others[name].inputs.get(START, "") if name in others else ""
    return False


def require_same_start(
    stage: Stage,
    others: Mapping[str, Stage],
    free: Set[str],
    roles: Sequence[str],
    settings: Sequence[str] = (),
) -> None:
    """Refuse a start whose network, inputs or outputs differ from those of `stage`.

    Args:
        free: Settings of the network that only training reads.
        roles: Inputs that both must have alike.
        settings: Keys of the config that both must have alike.
    """
    start = others.get(stage.inputs.get(START, ""))
    if start is None:
        return
    ours = stage.config
    theirs = start.config
    sizes = [name for name in type(ours.net).model_fields if name not in free]
    wrong = [f"net.{name}" for name in sizes if getattr(ours.net, name) != getattr(theirs.net, name, None)]
    if stage.kind.name != start.kind.name:
        wrong = [f"kind ({start.kind.name})"]
    wrong += [name for name in settings if getattr(ours, name) != getattr(theirs, name, None)]
    wrong += [f"inputs.{role}" for role in roles if not _alike(role, stage, start, others)]
    if wrong:
        known = {role: start.inputs.get(role, "") for role in roles if f"inputs.{role}" in wrong}
        there = [f"{role}: {place}" for role, place in known.items() if is_place(place)]
        like = f", like inputs: {{{', '.join(there)}}}" if there else ""
        raise UserError(
            f"stage '{stage.name}' starts from '{start.name}', which differs in {', '.join(wrong)}; give "
            f"both the same{like}"
        )


def _alike(role: str, stage: Stage, start: Stage, others: Mapping[str, Stage]) -> bool:
    """Whether both have the same input in a role, or the stage's was trained from the start's."""
    own = stage.inputs.get(role, "")
    first = start.inputs.get(role, "")
    if role == "text":
        return same_encoder(first, own, others)
    return (not first or own == first) if role == "stats" else starts_from(own, first, others)


def require_start_layout(data: MotionLayout, start: MotionLayout) -> None:
    """Refuse clips of another layout, family or frame rate than those that the start was trained on."""
    if data != start:
        require_layout(data, start, "the data of a training that starts from another")


def same_encoder(one: str, other: str, stages: Mapping[str, Stage]) -> bool:
    """Whether the text stages of these names are one stage, or two of one encoder; unknown ones pass."""
    if one == other or one not in stages or other not in stages:
        return True
    first = stages[one]
    second = stages[other]
    return first.kind.name == second.kind.name and _encoder(first) == _encoder(second)


def _encoder(stage: Stage) -> object:
    """The encoder that a text stage names, a folder by its place, or the whole config."""
    if is_place(stage.name) and in_export(Path(stage.name)):
        return TextSource(Path(stage.name).resolve(), "", CPU, exported=True).encoder_name
    spec = getattr(stage.config, "encoder", None)
    if not isinstance(spec, str):
        return stage.config
    folder = Path(spec).expanduser()
    return str(folder.resolve()) if folder.is_dir() else spec
