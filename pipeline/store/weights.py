"""Trained networks on disk: `model.safetensors`, and `model.json` with all that building them needs."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import torch
from pydantic import Field, PrivateAttr
from safetensors import SafetensorError
from safetensors.torch import load_file, save

from motionloom.datasets.base.files import atomic_path
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.store.files import write_json

Fact = TypeVar("Fact")

MODEL_FILES = ("model.safetensors", "model.json")
"""What a trained network leaves behind."""


class LayoutFacts(Config):
    """What `MotionLayout.named` needs to give the same layout again."""

    name: str
    fps: float
    family: str

    @staticmethod
    def of(layout: MotionLayout) -> LayoutFacts:
        return LayoutFacts(name=layout.name, fps=layout.fps, family=layout.family)

    def layout(self) -> MotionLayout:
        return MotionLayout.named(self.name, fps=self.fps, family=self.family)  # type: ignore[arg-type]


class ModelFacts(Config):
    """`model.json`."""

    kind: str
    config: dict[str, object]
    layout: LayoutFacts
    extra: dict[str, object] = Field(default_factory=dict)
    _where: str = PrivateAttr("model.json")

    def fact(self, key: str, kind: type[Fact]) -> Fact:
        """A fact in `extra`, of the kind it must be."""
        value = self.extra.get(key)
        if not isinstance(value, kind):
            missing = "is required" if key not in self.extra else f"= {value!r:.60} is no {kind.__name__}"
            raise UserError(f"{self.where}: key 'extra.{key}' {missing}; run or export the stage again")
        return value

    @property
    def where(self) -> str:
        return self._where


def save_model(folder: Path, net: torch.nn.Module, facts: ModelFacts) -> None:
    """Write weights and facts; the facts last."""
    state = {k: v.detach().contiguous().cpu() for k, v in net.state_dict().items()}
    with atomic_path(folder / "model.safetensors") as temporary:
        temporary.write_bytes(save(state))
    write_json(folder / "model.json", facts.dump())


def halve_weights(path: Path) -> None:
    """Write a file of weights again in half precision, 16 bits a number; networks compute in 32 all the same.

    What half precision has no room for (beyond 65,504) stays as it is, and so does what is no number.
    """
    largest = torch.finfo(torch.float16).max
    state = {
        name: value.half() if value.dtype == torch.float32 and bool((value.abs() <= largest).all()) else value
        for name, value in load_file(path).items()
    }
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(state))


def load_facts(folder: Path) -> ModelFacts:
    """Facts of the network in a folder."""
    facts = ModelFacts.load_json(folder / "model.json")
    facts._where = str(folder / "model.json")
    return facts


def load_weights(folder: Path, net: torch.nn.Module) -> None:
    """Fill `net`; a file that does not fit is refused by name."""
    path = folder / "model.safetensors"
    try:
        state = load_file(path)
        for name, value in state.items():
            if value.is_floating_point() and not bool(value.isfinite().all()):
                raise UserError(f"{path}: '{name}' holds numbers that are not finite; run its stage again")
        net.load_state_dict(state)
    except (FileNotFoundError, SafetensorError, RuntimeError) as error:
        why = " ".join(str(error).split())[:300]
        raise UserError(
            f"{path}: cannot load these weights; were they made by another version? Run the stage that made "
            f"them again ({why})"
        ) from None
