"""A profile of a few steps of a training by torch's profiler (`--profile`, `hardware.profile`)."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from torch.profiler import profile, schedule

from motionloom.datasets.base.files import atomic_path
from motionloom.models.training.distributed import rank
from motionloom.pipeline.store.training_log import FLIGHT

WARM_UP = 10
"""Steps of a training before those that are profiled: kernels are chosen and caches filled in them."""


def step_profiler(name: str, folder: Path, steps: int, left: int, console: Console) -> profile:
    """Profiles `steps` steps after the first `WARM_UP`, or the last of a training with fewer steps `left`.

    Each process leaves a trace in the stage's `flight/` folder, which Perfetto and Chrome open.
    """
    steps = min(steps, left)
    before, path = min(WARM_UP, left - steps), folder / FLIGHT / f"profile_rank_{rank()}.json.gz"

    def write(done: profile) -> None:
        with atomic_path(path) as temporary:
            whole = temporary.with_name(f"{temporary.name}.json.gz")  # torch packs what is called so
            done.export_chrome_trace(str(whole))
            whole.replace(temporary)
        console.print(
            f"    {name}: profile of {steps} steps in {path} (open it at ui.perfetto.dev)", soft_wrap=True
        )

    warm = min(1, before)
    phases = schedule(wait=before - warm, warmup=warm, active=steps, repeat=1)
    return profile(schedule=phases, on_trace_ready=write, record_shapes=True)
