"""The exported JSON schema accepts every shipped recipe and refuses what the recipe reader refuses."""

from __future__ import annotations

import jsonschema
import pytest

from motionloom.pipeline.runs.schema import recipe_schema
from motionloom.pipeline.runs.shipped import shipped_recipes
from motionloom.pipeline.store.yaml import read_yaml

VALIDATOR = jsonschema.Draft202012Validator(recipe_schema())


def test_schema_is_a_schema() -> None:
    jsonschema.Draft202012Validator.check_schema(recipe_schema())


@pytest.mark.parametrize("name", sorted(shipped_recipes()))
def test_shipped_recipes_pass(name: str) -> None:
    VALIDATOR.validate(read_yaml(shipped_recipes()[name]))


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


@pytest.mark.parametrize(
    ("defaults", "right"),
    [
        ({"trained": {"train": {"steps": 3}}, "vq": {"net": {"width": 8}}, "bvh": {"fps": 20}}, True),
        ({"trained": {"net": {"width": 8}}}, False),
        ({"vq": {"kind": "vq"}}, False),
        ({"vq": {"net": {"widht": 8}}}, False),
        ({"vqq": {}}, False),
    ],
)
def test_defaults_are_checked(defaults: dict, right: bool) -> None:
    stages = {"data": {"kind": "bvh"}, "vq": {"kind": "vq"}, "removed": None}
    assert VALIDATOR.is_valid({"name": "x", "defaults": defaults, "stages": stages}) == right
