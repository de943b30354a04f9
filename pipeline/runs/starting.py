"""`start:` of a recipe: the trained model that its stages go on from, said once.

    name: mine
    start: synthetic              # a model of the package, an export or a run, by its folder
    stages:
      data: {kind: bvh, source: mocap, captions: mocap/captions.jsonl, licence: unknown}
      text: {kind: text}
      tokenizer: {train: {steps: 300}}
      tokens: {kind: tokens}
      gpt: {lora: {rank: 16}, train: {steps: 500}}

A stage without a `kind` is trained on from the model's stage of that role: it is of the same kind and has the
same settings, but for `optim` and `train`. What the recipe does not train is the model's own: its statistics
always, its tokenizer and TMA where no stage is called so. Data come in the model's layout and frame rate, and
`generate` takes along the model's faces. All of it is written out in the resolved recipe, so a run needs no
`start` any more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.exported import open_exported
from motionloom.pipeline.contract.lookup import generators_of
from motionloom.pipeline.contract.registry import stage_kinds
from motionloom.pipeline.contract.stage import Every, Finished
from motionloom.pipeline.inference.shipped_models import model_folder, no_such_model
from motionloom.pipeline.runs.layers import merge
from motionloom.pipeline.runs.outside import place_name
from motionloom.pipeline.runs.shipped import nearest
from motionloom.pipeline.store.outside import BUNDLE_FILE
from motionloom.pipeline.store.weights import load_facts

START = "start"
"""Key of a recipe, and the role in which a stage takes the network that it goes on from."""

_OWN = ("optim", "train")
"""Settings that a training does not take over from the one before it."""


@dataclass(frozen=True)
class StartingModel:
    """A trained GPT and what it was trained with."""

    name: str
    stages: Mapping[str, Finished]
    """By role: gpt, tokenizer, stats, and tma where it has one."""
    faces: tuple[Finished, ...]
    """Its generators of faces."""
    layout: MotionLayout
    """Of its motion."""

    @staticmethod
    def open(name: str, where: str) -> StartingModel:
        """The model in a folder; `where` is what names it, for messages."""
        made = _generators(name, f"{where}: {START} = '{name}'")
        gpts = [stage for stage in made if stage.kind.name == "gpt" and not stage.config.face]
        if not gpts:
            kinds = ", ".join(dict.fromkeys(stage.kind.name for stage in made)) or "nothing"
            raise UserError(
                f"{where}: {START} = '{name}': trainings start from a model whose body is made by a stage of "
                f"kind gpt; this one has {kinds}"
            )
        gpt, tokenizer = gpts[0], gpts[0].inputs["tokenizer"]
        stages = {"gpt": gpt, "tokenizer": tokenizer, "stats": tokenizer.inputs["stats"]}
        if "tma" in gpt.inputs:
            stages["tma"] = gpt.inputs["tma"]
        faces = tuple(stage for stage in made if stage not in gpts and _of_face(stage))
        return StartingModel(name, stages, faces, load_facts(tokenizer.folder).layout.layout())


def _generators(name: str, where: str) -> list[Finished]:
    folder = model_folder(Path(name).expanduser())
    if (folder / BUNDLE_FILE).is_file():
        return open_exported(folder)
    if (folder / "recipe.yaml").is_file():
        return generators_of(folder)
    if not folder.exists():
        raise UserError(f"{where}: {no_such_model(name)}")
    raise UserError(f"{where}: neither an export nor a run; name the folder of one")


def _of_face(stage: Finished) -> bool:
    return bool(getattr(stage.config, "face", False)) or getattr(stage.config, "part", "") == "face"


def with_start(data: Mapping[str, Any], where: str) -> dict[str, Any]:
    """A recipe as plain data without its `start`: what its stages take from that is written out."""
    out = dict(data)
    name, stages = out.pop(START, None), out.get("stages")
    if name is None or not isinstance(stages, dict):
        return out
    if not isinstance(name, str):
        raise UserError(f"{where}: {START} must be the name or the folder of a trained model")
    model = StartingModel.open(name, where)
    missing = {role: stage for role, stage in model.stages.items() if role not in stages}
    out["stages"] = {
        key: _entry(key, entry, model, missing, where) if isinstance(entry, dict) else entry
        for key, entry in stages.items()
    }
    return out


def _entry(
    key: str, entry: dict[str, Any], model: StartingModel, missing: Mapping[str, Finished], where: str
) -> dict[str, Any]:
    """A stage's entry with what the model says of it; `missing` are those of its stages that fill roles."""
    inputs: dict[str, Any] = dict(entry.get("inputs") or {})
    if "kind" not in entry:
        stage = model.stages.get(key)
        if stage is None or not stage.kind.trains:
            known = [role for role, found in model.stages.items() if found.kind.trains]
            raise UserError(
                f"{where}: stages.{key} has no kind, and {START} '{model.name}' has no '{key}' to go on from"
                f"{nearest(key, known)}"
            )
        settings = {field: value for field, value in stage.config.dump().items() if field not in _OWN}
        entry = merge({"kind": stage.kind.name, **settings}, entry)
        inputs.setdefault(START, place_name(stage.folder))
    kind = stage_kinds().get(str(entry["kind"]))
    if kind is None:
        return entry  # refused by its name later
    roles = {role.name: role for role in kind.roles()}
    for role, stage in missing.items():
        if role in roles and not isinstance(roles[role], Every):
            inputs.setdefault(role, place_name(stage.folder))
    if kind.name == "generate" and model.faces and "gpt" not in missing:
        # Faces are none of what is trained here, and go with the model.
        faces = [place_name(stage.folder) for stage in model.faces]
        inputs.setdefault("generators", ["gpt", *faces])
    entry = entry | _layout(key, entry, kind.config, model, where)
    return {**entry, "inputs": inputs} if inputs else entry


def _layout(
    key: str, entry: Mapping[str, Any], config: Any, model: StartingModel, where: str
) -> dict[str, Any]:
    """Layout and frame rate of an entry that brings data: the model's."""
    wanted = {"layout": model.layout.name, "fps": model.layout.fps}
    out = {field: value for field, value in wanted.items() if field in config.model_fields}
    for field, value in out.items():
        if entry.get(field, value) != value:
            raise UserError(
                f"{where}: stages.{key}.{field} = {entry[field]}, but {START} '{model.name}' was trained on "
                f"{field} {value}; leave it out"
            )
    return out
