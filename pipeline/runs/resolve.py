"""A recipe as plain data, from all that says something about it: one walk, `resolve`.

    extends: humantomato-tiny     # another recipe: a file next to this one, or a shipped one
    name: mine
    start: synthetic              # a trained model to go on from: of the package, an export or a run
    defaults:
      trained: {optim: {schedule: cosine}, train: {precision: bf16-mixed, batch_size: 256}}
      vq: {net: {width: 256}}
    stages:
      data: {kind: bvh, source: mocap, captions: mocap/captions.jsonl, licence: unknown}
      tokenizer: {train: {steps: 300}}
      face_gpt: null

The later layer wins: what is extended, the file itself, `--set`. Mappings merge key by key, lists are
replaced whole; a stage of another kind replaces the old one whole, and `null` removes it. Then each stage's
entry goes over what the `start` model says of it and over the `defaults` of its kind, and those over
`trained`, which concerns all stages that train. A length in `train` may be `epochs` of a number of `clips`;
the layer that says steps or epochs last decides. `published: true` puts between the two the settings by which
the baselines were published (`pipeline/runs/published.yaml`), for which `trained` is not meant.

With `start`, a stage without a `kind` is trained on from the model's stage of that name: same kind, same
settings but for `optim` and `train`. What the recipe does not train is the model's own: its statistics, its
tokenizer, its TMA. Data come in the model's layout and frame rate, and `generate` takes along its faces.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from motionloom.datasets.base.config import explain
from motionloom.datasets.base.errors import UserError, nearest
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.contract.stage import CompletedStage, Every, StageConfig, stage_kinds
from motionloom.pipeline.runs.layers import START, Tree, layered, place_name, read_file
from motionloom.pipeline.store.run_folder import BUNDLE_FILE
from motionloom.pipeline.store.weights import load_facts
from motionloom.pipeline.store.yaml import merge, read_yaml
from motionloom.pipeline.training.config import TrainConfig, TrainedStageConfig

TRAINED = "trained"
"""The defaults of every stage that trains."""
PUBLISHED = "published"
"""The defaults by which baselines take their published settings."""

_LENGTH = ("epochs", "clips")
"""A training's length, of which steps are made."""
_OWN = ("optim", "train")
"""Settings that a training does not take over from the model it starts from."""
_COMPLETED_LATER = {"missing", "value_error"}
"""Errors that defaults may have, since a stage's own entry completes them."""


def published_settings() -> dict[str, Tree]:
    """The rows of `published.yaml` by model."""
    table: dict[str, Tree] = read_yaml(Path(__file__).with_name("published.yaml"))
    return table


def in_steps(settings: Tree, where: str, per_epoch: Fraction | None = None) -> Tree:
    """Settings whose lengths in epochs became steps, at any depth; `UserError` begins with `where`.

    `train: {epochs: E, clips: N, batch_size: B}` is `steps` E N / B; `drop_at_epochs` are `drop_at` alike.
    """
    train = settings.get("train")
    if isinstance(train, dict) and {*_LENGTH} & train.keys():
        counts = {name: train.get(name, 1) for name in (*_LENGTH, "batch_size")}
        if not all(isinstance(one, int) and one > 0 for one in counts.values()) or "clips" not in train:
            raise UserError(f"{where}.train: epochs need clips and batch_size, whole numbers above 0")
        per_epoch = Fraction(counts["clips"], counts["batch_size"])
        kept = {key: value for key, value in train.items() if key not in _LENGTH}
        if "epochs" in train:
            if "steps" in train:
                raise UserError(f"{where}.train has steps and epochs; say steps alone")
            kept["steps"] = round(counts["epochs"] * per_epoch)
        settings = {**settings, "train": kept}
    out: Tree = {}
    for key, value in settings.items():
        if isinstance(value, dict):
            out[key] = in_steps(value, f"{where}.{key}", per_epoch)
        elif key == "drop_at_epochs" and per_epoch and isinstance(value, list):
            out["drop_at"] = [round(one * per_epoch) if isinstance(one, int) else one for one in value]
        else:
            out[key] = value
    return out


def _over(below: Tree, layer: Tree) -> Tree:
    """`layer` over `below`, whose length in epochs it replaces by one in steps, or the other way round."""
    said = layer.get("train")
    old = below.get("train")
    if isinstance(said, dict) and isinstance(old, dict):
        replaced = "epochs" if "steps" in said else "steps" if "epochs" in said else None
        below = {**below, "train": {key: value for key, value in old.items() if key != replaced}}
    return merge(below, layer)


def resolve(path: Path, overrides: Sequence[str], where: str) -> Tree:
    """A recipe with all that it builds on and `--set` applied; each stage has what it shares with others.

    `where` is the recipe's name in messages.
    """
    as_written = layered(path, ())
    # Defaults of what is extended may concern stages that this recipe has replaced; its own may not.
    _require_used(read_file(path).get("defaults"), as_written.get("stages"), str(path))
    inherited = set(as_written.get("defaults") or ())
    data = layered(path, overrides, _place_of)
    name = data.pop(START, None)
    stages = data.get("stages")
    defaults = data.pop("defaults", None) or {}
    if not isinstance(defaults, dict):
        raise UserError(f"{where}: defaults must map kinds of stages to settings")
    published = published_settings() if defaults.pop(PUBLISHED, False) is True else {}
    for key, fields in defaults.items():
        _require_default(key, fields, where)
    if not isinstance(stages, dict):
        return data
    # Layers are merged now; each stage's entry is completed by what is more general than it.
    model = None if name is None else StartingModel.open(name, where)
    missing = {} if model is None else {r: one for r, one in model.stages.items() if r not in stages}
    for key, entry in stages.items():
        if not isinstance(entry, dict):
            continue  # refused as the recipe is parsed
        if model is not None:
            entry = model.entry(key, entry, missing, where)
        elif "kind" not in entry:
            others = [other for other, its in stages.items() if isinstance(its, dict) and "kind" in its]
            hint = f", nor has a recipe that it extends{nearest(key, others)}" if others else ""
            raise UserError(f"{where}: stages.{key} says no kind{hint}")
        shared: Tree = {}
        for concerning in _defaults_of(entry):
            shared = _over(shared, published.get(concerning, {}).get("stage", {}))
            shared = _over(shared, defaults.get(concerning, {}))
        stages[key] = in_steps(_over(shared, entry), f"{where}: stages.{key}")
    _require_used(defaults.keys() - inherited, stages, where)
    return data


# `defaults:`.


def _defaults_of(entry: Mapping[str, object]) -> list[str]:
    """The keys of `defaults` that concern an entry, the most general first."""
    kind = stage_kinds().get(str(entry.get("kind")))
    if kind is None:
        return []
    return [TRAINED, kind.name] if issubclass(kind.config, TrainedStageConfig) else [kind.name]


def _place_of(parts: Sequence[str], stages: Mapping[str, Any]) -> str:
    """A hint for a setting of trainings that was named without its stage; "" where it is none."""
    trained = [
        name for name, entry in stages.items() if isinstance(entry, dict) and TRAINED in _defaults_of(entry)
    ]
    for group, config in (("optim", OptimConfig), ("train", TrainConfig)):
        own = parts[1:] if parts[0] == group else parts
        if trained and len(own) == 1 and own[0] in config.model_fields:
            key = f"{group}.{own[0]}"
            some = " or ".join(f"{name}.{key}" for name in trained[:3])
            return f"; say for which training: {some}; or defaults.{TRAINED}.{key} for all that state none"
    return ""


def _require_used(keys: Iterable[str] | None, stages: object, where: str) -> None:
    """Refuse defaults that concern no stage."""
    entries = [one for one in stages.values() if isinstance(one, dict)] if isinstance(stages, dict) else []
    if any("kind" not in entry for entry in entries):
        return  # of the kinds of the model that the recipe starts from
    concerned = {key for entry in entries for key in _defaults_of(entry)}
    for key in keys or ():
        if key not in concerned and (key == TRAINED or key in stage_kinds()):
            whom = "that trains" if key == TRAINED else f"of kind {key}"
            raise UserError(f"{where}: defaults.{key} concerns no stage: there is none {whom}; leave it out")


def _require_default(key: str, fields: object, where: str) -> None:
    """Refuse keys that no such stage has, and values that cannot be right in any."""
    kinds = stage_kinds()
    if key != TRAINED and key not in kinds:
        raise UserError(f"{where}: defaults.{key}: no stage kind '{key}'{nearest(key, [TRAINED, *kinds])}")
    config: type[StageConfig] = TrainedStageConfig if key == TRAINED else kinds[key].config
    if isinstance(fields, dict) and isinstance(train := fields.get("train"), dict):
        fields = {**fields, "train": {name: value for name, value in train.items() if name not in _LENGTH}}
    try:
        config.model_validate(fields)
    except ValidationError as error:
        wrong = [item for item in error.errors() if item["type"] not in _COMPLETED_LATER]
        if wrong:
            raise UserError(explain(wrong, config, f"{where}: defaults.{key}")) from None


# `start:`.


@dataclass(frozen=True)
class StartingModel:
    """A trained GPT and what it was trained with."""

    name: str
    stages: Mapping[str, CompletedStage]
    """By role: gpt, tokenizer, stats, and tma where it has one."""
    faces: tuple[CompletedStage, ...]
    """Its generators of faces."""
    layout: MotionLayout
    """Layout and frame rate of its motion."""

    @staticmethod
    def open(name: object, where: str) -> StartingModel:
        """The model in a folder, or of the package; `where` is what names it, for messages."""
        if not isinstance(name, str):
            raise UserError(f"{where}: {START} must be the name or the folder of a trained model")
        generators = _generators(name, f"{where}: {START} = '{name}'")
        gpts = [stage for stage in generators if stage.kind.name == "gpt" and not stage.config.face]
        if not gpts:
            kinds = ", ".join(dict.fromkeys(stage.kind.name for stage in generators)) or "nothing"
            raise UserError(
                f"{where}: {START} = '{name}': trainings start from a model whose body is made by a stage of "
                f"kind gpt; this one has {kinds}"
            )
        gpt = gpts[0]
        tokenizer = gpts[0].inputs["tokenizer"]
        stages = {"gpt": gpt, "tokenizer": tokenizer, "stats": tokenizer.inputs["stats"]}
        if "tma" in gpt.inputs:
            stages["tma"] = gpt.inputs["tma"]
        # Whose config says so: a GPT or a diffusion model of the face, a VAE of that part.
        faces = tuple(
            stage
            for stage in generators
            if getattr(stage.config, "face", False) or getattr(stage.config, "part", "") == "face"
        )
        return StartingModel(name, stages, faces, load_facts(tokenizer.folder).layout.layout())

    def entry(self, key: str, entry: Tree, missing: Mapping[str, CompletedStage], where: str) -> Tree:
        """A stage's entry with what the model says of it."""
        inputs: Tree = dict(entry.get("inputs") or {})
        if "kind" not in entry:
            stage = self.stages.get(key)
            if stage is None or not stage.kind.trains:
                trained = [role for role, stage_of_model in self.stages.items() if stage_of_model.kind.trains]
                raise UserError(
                    f"{where}: stages.{key} has no kind, and {START} '{self.name}' has no '{key}' to go on "
                    f"from{nearest(key, trained)}"
                )
            settings = {name: value for name, value in stage.config.dump().items() if name not in _OWN}
            entry = merge({"kind": stage.kind.name, **settings}, entry)
            inputs.setdefault(START, place_name(stage.folder))
        kind = stage_kinds().get(str(entry["kind"]))
        if kind is None:
            return entry  # refused by its name later
        roles = {role.name: role for role in kind.roles()}
        for role, stage in missing.items():
            if role in roles and not isinstance(roles[role], Every):
                inputs.setdefault(role, place_name(stage.folder))
        if kind.name == "generate" and self.faces and "gpt" not in missing:
            # Faces are none of what is trained here, and go with the model.
            inputs.setdefault("generators", ["gpt", *(place_name(stage.folder) for stage in self.faces)])
        entry = entry | self._layout(key, entry, kind.config, where)
        return {**entry, "inputs": inputs} if inputs else entry

    def _layout(self, key: str, entry: Tree, config: type[StageConfig], where: str) -> Tree:
        """Layout and frame rate of an entry that brings data: the model's."""
        wanted = {"layout": self.layout.name, "fps": self.layout.fps}
        out = {name: value for name, value in wanted.items() if name in config.model_fields}
        for name, value in out.items():
            if entry.get(name, value) != value:
                raise UserError(
                    f"{where}: stages.{key}.{name} = {entry[name]}, but {START} '{self.name}' was trained on "
                    f"{name} {value}; leave it out"
                )
        return out


def _generators(name: str, where: str) -> list[CompletedStage]:
    # What opens models is imported where a recipe starts from one.
    from motionloom.pipeline.contract.lookup import generators_of, open_exported
    from motionloom.pipeline.inference.shipped_models import model_folder, no_such_model

    folder = model_folder(Path(name).expanduser())
    if (folder / BUNDLE_FILE).is_file():
        return open_exported(folder)
    if (folder / "recipe.yaml").is_file():
        return generators_of(folder)
    if not folder.exists():
        raise UserError(f"{where}: {no_such_model(name)}")
    raise UserError(f"{where}: neither an export nor a run; name the folder of one")
