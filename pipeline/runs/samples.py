"""Draw motions with the newest checkpoint of a training that goes on (`train.sample_every`).

    python -m motionloom.pipeline.runs.samples RUN STAGE

On the CPU and with the lowest priority: the training has the machine.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

import torch

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.evaluation.clip_metrics import Performance, measure_clip, metrics_of
from motionloom.pipeline.evaluation.dances import dance_to, dances_for
from motionloom.pipeline.evaluation.estimate import row_estimates
from motionloom.pipeline.evaluation.truth import perform, spread_truths
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.files.outputs import page_note, write_motions
from motionloom.pipeline.inference.files.writers import default_formats
from motionloom.pipeline.runs.snapshot import NEWEST, run_at
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.files import open_own
from motionloom.pipeline.store.run_folder import stage_folder
from motionloom.pipeline.store.training_log import SAMPLE_FIGURES, SAMPLES

_COUNT = 4
"""Clips of the validation split whose captions or music are drawn for."""
_DANCE_SECONDS = 10.0


def draw_samples(run: Path, stage: str) -> Path:
    """Write motions and their figures into the stage's folder `samples`; returns the motions' folder.

    A row of figures has, of each table of `clip_metrics` that needs no other network, the first column: of
    the motions ("drawn/...") and of what was recorded ("recorded/...").
    """
    with run_at(run, f"{stage}:{NEWEST}") as folder:
        artifact = Artifact.find(stage_folder(folder, stage))
        bundle = Bundle.from_run(folder)
        terms = bundle.terms  # of stages that are found while their folder is there
        assert artifact is not None and artifact.step is not None
        data = next(one for one in bundle.main.upstream() if one.gives("data"))
        clips = bundle.stage_cache.get(data).held_out()
        fps = clips.layout.fps
        if "text" in bundle.generator.modalities:
            metrics = metrics_of("captions")
            truths = spread_truths(clips, _COUNT)
            made = perform(bundle, truths)
            real = [Performance(one.joints, one.joints, fps, one.face, one.truth) for one in truths]
        else:
            metrics = metrics_of("dances")
            dances = dances_for(bundle, clips, _COUNT, seconds=_DANCE_SECONDS)
            if not dances:
                raise UserError(f"{data.folder}: no clip of the validation split has music to dance to")
            made = dance_to(bundle, dances)
            real = [
                Performance(one.joints, one.joints, fps, truth=one.truth, beats=one.beats) for one in dances
            ]
    drawn = [
        replace(one, joints=motion.joints, face=motion.face) for one, motion in zip(real, made, strict=True)
    ]
    row: dict[str, float] = {"step": artifact.step}
    for who, performances in (("drawn", drawn), ("recorded", real)):
        found = row_estimates([[measure_clip(metrics, one) for one in performances]])
        first = (metric.columns[0].name for metric in metrics)
        row |= {f"{who}/{name}": found[name].value for name in first if name in found}
    place = stage_folder(run, stage) / SAMPLES
    out = place / f"step={artifact.step:08d}"
    title = f"{stage} at step {artifact.step:,}"
    note = page_note(len(made), run.resolve().name, 0, terms=terms)
    write_motions(out, made, default_formats(), title=title, note=note)
    with open_own(place / SAMPLE_FIGURES, "ab") as file:
        file.write(json.dumps(row).encode() + b"\n")
    return out


if __name__ == "__main__":
    os.nice(19)
    torch.set_num_threads(1)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # leaves no copy of the weights behind
    print(draw_samples(Path(sys.argv[1]), sys.argv[2]))
