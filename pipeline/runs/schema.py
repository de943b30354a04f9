"""The JSON schema of recipes, from the config classes that check them, so that editors complete and check.

In an editor with a YAML language server, put this on a recipe's first line:
`# yaml-language-server: $schema=recipe.schema.json`
"""

from __future__ import annotations

from typing import Any

from motionloom.pipeline.contract.registry import stage_kinds
from motionloom.pipeline.contract.stage import Every, StageConfig, StageKind
from motionloom.pipeline.runs.defaults import TRAINED
from motionloom.pipeline.runs.recipe import RecipeFile
from motionloom.pipeline.stages.train_config import TrainedStageConfig


def recipe_schema() -> dict[str, Any]:
    """Draft 2020-12 schema of a recipe file: one branch per stage kind, told apart by `kind`."""
    schema = RecipeFile.model_json_schema()
    definitions: dict[str, Any] = schema.setdefault("$defs", {})
    branches, kinds = [], stage_kinds()
    defaults: dict[str, Any] = {TRAINED: _fields(TrainedStageConfig, definitions)}
    for name, kind in kinds.items():
        stage = _fields(kind.config, definitions)
        defaults[name] = dict(stage)
        stage["title"] = f"{name}: {kind.summary}"
        stage["properties"] = {
            "kind": {"const": name},
            "inputs": _inputs(kind),
            **stage.get("properties", {}),
        }
        branches.append(
            {"if": {"properties": {"kind": {"const": name}}, "required": ["kind"]}, "then": stage}
        )
    entry = {"type": "object", "properties": {"kind": {"enum": list(kinds)}}, "allOf": branches}
    removed = {"type": "null", "description": "Leaves out a stage of the recipe that this one extends."}
    schema["properties"]["stages"]["additionalProperties"] = {"anyOf": [entry, removed]}
    schema["properties"]["defaults"] = {
        "type": "object",
        "description": f"What stages of a kind share, or all that train ({TRAINED}).",
        "properties": defaults,
        "additionalProperties": False,
    }
    schema["properties"]["extends"] = {"type": "string", "description": "A recipe to start from, by name."}
    schema["required"] = ["name"]
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "motionloom recipe"
    return schema


def _fields(config: type[StageConfig], definitions: dict[str, Any]) -> dict[str, Any]:
    """The schema of a stage's fields, none of them required: a base recipe or defaults may give them."""
    schema = config.model_json_schema(ref_template="#/$defs/{model}")
    definitions.update(schema.pop("$defs", {}))
    schema.pop("required", None)
    return schema


def _inputs(kind: StageKind) -> dict[str, Any]:
    one: dict[str, Any] = {"type": ["string", "null"]}
    several: dict[str, Any] = {"type": "array", "items": {"type": "string"}}
    return {
        "type": "object",
        "description": (
            "Which stage feeds a role; without it the stage of the role's own name. A path is a stage of "
            "another run or of an export: runs/other/stages/gpt."
        ),
        "properties": {role.name: several if isinstance(role, Every) else one for role in kind.roles()},
        "additionalProperties": False,
    }
