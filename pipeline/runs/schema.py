"""The JSON schema of recipes, from the config classes that check them, so that editors complete and check.

In an editor with a YAML language server, put this on a recipe's first line:
`# yaml-language-server: $schema=recipe.schema.json`
"""

from __future__ import annotations

from typing import Any

from motionloom.pipeline.contract.registry import stage_kinds
from motionloom.pipeline.contract.stage import Every, StageKind
from motionloom.pipeline.runs.recipe import RecipeFile


def recipe_schema() -> dict[str, Any]:
    """Draft 2020-12 schema of a recipe file: one branch per stage kind, told apart by `kind`."""
    schema = RecipeFile.model_json_schema()
    definitions: dict[str, Any] = schema.setdefault("$defs", {})
    branches, kinds = [], stage_kinds()
    for name, kind in kinds.items():
        stage = kind.config.model_json_schema(ref_template="#/$defs/{model}")
        definitions.update(stage.pop("$defs", {}))
        stage["title"] = f"{name}: {kind.summary}"
        stage["properties"] = {
            "kind": {"const": name},
            "inputs": _inputs(kind),
            **stage.get("properties", {}),
        }
        # With `extends` a stage may leave out what its base recipe gives.
        stage.pop("required", None)
        branches.append(
            {"if": {"properties": {"kind": {"const": name}}, "required": ["kind"]}, "then": stage}
        )
    schema["properties"]["stages"]["additionalProperties"] = {
        "type": "object",
        "properties": {"kind": {"enum": list(kinds)}},
        "allOf": branches,
    }
    schema["properties"]["extends"] = {"type": "string", "description": "A recipe to start from, by name."}
    schema["required"] = ["name"]
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "motionloom recipe"
    return schema


def _inputs(kind: StageKind) -> dict[str, Any]:
    one: dict[str, Any] = {"type": ["string", "null"]}
    several: dict[str, Any] = {"type": "array", "items": {"type": "string"}}
    return {
        "type": "object",
        "description": "Which stage feeds a role; without it the stage of the role's own name.",
        "properties": {role.name: several if isinstance(role, Every) else one for role in kind.roles()},
        "additionalProperties": False,
    }
