"""Command line, recipes, the stage graph, training, generation and pages.

The names below are the Python API (`docs/generating.md`). Each is imported on first use: `import
motionloom.pipeline` alone brings in no torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from motionloom.datasets.audio.sound import Sound
    from motionloom.datasets.schema import UserError
    from motionloom.pipeline.contract.generation import Prompt
    from motionloom.pipeline.contract.sampling import SamplingConfig, StreamConfig
    from motionloom.pipeline.contract.stage import StageKind, register
    from motionloom.pipeline.inference.captioning import captions
    from motionloom.pipeline.inference.model import MotionModel
    from motionloom.pipeline.inference.motion import GeneratedMotion, MotionChunk, joined
    from motionloom.pipeline.inference.outputs import write_motions
    from motionloom.pipeline.inference.stream import MotionStream
    from motionloom.pipeline.results.compare.command import compare_runs
    from motionloom.pipeline.results.paper.compare import compare_with_paper
    from motionloom.pipeline.runs.api import evaluate_run, export_run, report_run, run_recipe
    from motionloom.pipeline.runs.recipe import Recipe, load_recipe
    from motionloom.pipeline.training.trained_stage import TrainedStage

__all__ = [
    "GeneratedMotion",
    "MotionChunk",
    "MotionModel",
    "MotionStream",
    "Prompt",
    "Recipe",
    "SamplingConfig",
    "Sound",
    "StageKind",
    "StreamConfig",
    "TrainedStage",
    "UserError",
    "captions",
    "compare_runs",
    "compare_with_paper",
    "evaluate_run",
    "export_run",
    "joined",
    "load_recipe",
    "register",
    "report_run",
    "run_recipe",
    "write_motions",
]

_HOMES = {
    "GeneratedMotion": "pipeline.inference.motion",
    "MotionChunk": "pipeline.inference.motion",
    "MotionModel": "pipeline.inference.model",
    "MotionStream": "pipeline.inference.stream",
    "Prompt": "pipeline.contract.generation",
    "Recipe": "pipeline.runs.recipe",
    "SamplingConfig": "pipeline.contract.sampling",
    "Sound": "datasets.audio.sound",
    "StageKind": "pipeline.contract.stage",
    "StreamConfig": "pipeline.contract.sampling",
    "TrainedStage": "pipeline.training.trained_stage",
    "UserError": "datasets.schema",
    "captions": "pipeline.inference.captioning",
    "compare_runs": "pipeline.results.compare.command",
    "compare_with_paper": "pipeline.results.paper.compare",
    "evaluate_run": "pipeline.runs.api",
    "export_run": "pipeline.runs.api",
    "joined": "pipeline.inference.motion",
    "load_recipe": "pipeline.runs.recipe",
    "register": "pipeline.contract.stage",
    "report_run": "pipeline.runs.api",
    "run_recipe": "pipeline.runs.api",
    "write_motions": "pipeline.inference.outputs",
}


def __getattr__(name: str) -> Any:
    """A name of the API, from where it is defined."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"motionloom.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
