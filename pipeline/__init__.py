"""Command line, recipes, the stage graph, training, generation and pages.

The names below are the Python API (`docs/generating.md`). Each is imported on first use: `import
motionloom.pipeline` alone brings in no torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # `as` has type checkers take the names for exported ones
    from motionloom.datasets.audio.sound import Sound as Sound
    from motionloom.datasets.base.register import register as register
    from motionloom.datasets.schema import UserError as UserError
    from motionloom.pipeline.contract.generation import Prompt as Prompt
    from motionloom.pipeline.contract.sampling import SamplingConfig as SamplingConfig
    from motionloom.pipeline.contract.sampling import StreamConfig as StreamConfig
    from motionloom.pipeline.contract.stage import StageKind as StageKind
    from motionloom.pipeline.inference.captioning import captions as captions
    from motionloom.pipeline.inference.model import MotionModel as MotionModel
    from motionloom.pipeline.inference.motion import GeneratedMotion as GeneratedMotion
    from motionloom.pipeline.inference.motion import MotionChunk as MotionChunk
    from motionloom.pipeline.inference.motion import joined as joined
    from motionloom.pipeline.inference.outputs import write_motions as write_motions
    from motionloom.pipeline.inference.stream import MotionStream as MotionStream
    from motionloom.pipeline.results.compare.command import compare_runs as compare_runs
    from motionloom.pipeline.results.paper.compare import compare_with_paper as compare_with_paper
    from motionloom.pipeline.runs.api import evaluate_run as evaluate_run
    from motionloom.pipeline.runs.api import export_run as export_run
    from motionloom.pipeline.runs.api import report_run as report_run
    from motionloom.pipeline.runs.api import run_recipe as run_recipe
    from motionloom.pipeline.runs.recipe import Recipe as Recipe
    from motionloom.pipeline.runs.recipe import load_recipe as load_recipe
    from motionloom.pipeline.training.trained_stage import TrainedStage as TrainedStage

_NAMES = {
    "datasets.audio.sound": "Sound",
    "datasets.base.register": "register",
    "datasets.schema": "UserError",
    "pipeline.contract.generation": "Prompt",
    "pipeline.contract.sampling": "SamplingConfig StreamConfig",
    "pipeline.contract.stage": "StageKind",
    "pipeline.inference.captioning": "captions",
    "pipeline.inference.model": "MotionModel",
    "pipeline.inference.motion": "GeneratedMotion MotionChunk joined",
    "pipeline.inference.outputs": "write_motions",
    "pipeline.inference.stream": "MotionStream",
    "pipeline.results.compare.command": "compare_runs",
    "pipeline.results.paper.compare": "compare_with_paper",
    "pipeline.runs.api": "evaluate_run export_run report_run run_recipe",
    "pipeline.runs.recipe": "Recipe load_recipe",
    "pipeline.training.trained_stage": "TrainedStage",
}
"""Module -> the names of the API that it defines."""
_HOMES = {name: module for module, names in _NAMES.items() for name in names.split()}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """A name of the API, from where it is defined."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"motionloom.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
