"""The exported JSON schema accepts every shipped recipe and refuses what the recipe reader refuses."""

from __future__ import annotations

import jsonschema
import pytest
import yaml

from motionloom.pipeline.runs.schema import recipe_schema
from motionloom.pipeline.runs.shipped import shipped_recipes

VALIDATOR = jsonschema.Draft202012Validator(recipe_schema())


def test_schema_is_a_schema() -> None:
    jsonschema.Draft202012Validator.check_schema(recipe_schema())


@pytest.mark.parametrize("name", sorted(shipped_recipes()))
def test_shipped_recipes_pass(name: str) -> None:
    VALIDATOR.validate(yaml.safe_load(shipped_recipes()[name].read_text()))


@pytest.mark.parametrize(
    "stage",
    [
        {"kind": "tma", "optim": {"lrr": 1}},
        {"kind": "tma", "optim": {"lr": -1}},
        {"kind": "tma", "inputs": {"dat": "data"}},
        {"kind": "nothing"},
        {"kind": "gpt", "prior": "words"},
    ],
)
def test_mistakes_are_refused(stage: dict) -> None:
    assert not VALIDATOR.is_valid({"name": "x", "stages": {"s": stage}})
