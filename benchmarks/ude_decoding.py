"""What DMD's samplers cost and give, and whether scripts change over smoothly: two proofs of a UDE run.

    motionloom run ude-learning
    python benchmarks/ude_decoding.py runs/ude-learning --samplers --transitions

`--samplers`: true tokens of one window of held-out dances decoded by 20 steps of DPM-Solver++, by DDIM and by
all of DDPM's steps, several times each: distance to what was recorded, Beat Align, feet, roughness, seconds.
Differences count against the spread of the repeats.

`--transitions`: scripts of a caption, a song and another caption. At each border the acceleration of the
joints and the speed of the root as percentiles among those inside the segments of the same motion
(`models/metrics/transitions.py`), with bridges, with every token decoded, and beside the same segments made
apart and joined; close to the border and so far around it that a bridge is covered; and foot skating.

Writes `decoding.json` into the run's folder.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from motionloom.datasets.motion.joints import joints_of, local_joints_of
from motionloom.models.diffusion.dmd_sampling import decode_motions
from motionloom.models.diffusion.schedule import Sampler
from motionloom.models.gpt.drawing import sample_seeds
from motionloom.models.metrics.dance import foot_skating
from motionloom.models.metrics.transitions import accelerations, transition_percentiles
from motionloom.models.tokenizer.base import GROUP_FRAMES
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import Shelf
from motionloom.pipeline.evaluation.dance_figures import Matched, alignment_of
from motionloom.pipeline.evaluation.dances import DanceClip, dances_of
from motionloom.pipeline.evaluation.truth import spread, truth_of
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.script import DrivenSegment

Joints = NDArray[np.float64]

REACH = {"at the border": 2, "around it": 10}
"""Frames to either side of which the largest figure counts; ten cover a bridge of sixteen."""


def quality(clips: Sequence[DanceClip], made: Sequence[Joints]) -> dict[str, float]:
    """Of one motion a clip."""
    fps = clips[0].fps
    error = [
        np.linalg.norm(local_joints_of(m, fps) - local_joints_of(c.joints, fps), axis=-1).mean()
        for c, m in zip(clips, made, strict=True)
    ]
    return {
        "pose error, mm": 1000 * float(np.mean(error)),
        "Beat Align": alignment_of([Matched(m, c) for c, m in zip(clips, made, strict=True)])["bailando"],
        "foot skating": float(np.mean([foot_skating(m, fps) for m in made])),
        "acceleration, m/s2": float(np.mean([accelerations(m, fps).mean() for m in made])),
    }


def samplers(run: Path, count: int, repeats: int, console: Console) -> dict[str, Any]:
    """Sampler -> figures of each repeat."""
    stages, shelf = finished_stages(run), Shelf()
    tokenizer, dmd = shelf.get(stages["tokenizer"]), shelf.get(stages["dmd"])
    dataset = shelf.get(stages["data"]).split("test")
    clips = dances_of(dataset, count, unit=GROUP_FRAMES, seconds=dmd.window / dataset.layout.fps)
    columns = tokenizer.columns
    codes = tokenizer.encode([np.asarray(dataset.motion(c.index))[: len(c.joints), columns] for c in clips])
    whole = dmd.net.config.schedule.steps
    out: dict[str, Any] = {"recorded": [quality(clips, [c.joints for c in clips])]}
    for name, steps in (("dpm++", 20), ("ddim", 50), ("ddpm", whole)):
        rows = []
        for repeat in range(repeats):
            seeds, start = sample_seeds(repeat, len(clips)), time.perf_counter()
            made = decode_motions(
                dmd.net, codes, seeds=seeds, sampler=cast(Sampler, name), steps=steps, window=dmd.window
            )
            seconds = time.perf_counter() - start
            joints = [joints_of(tokenizer.of_coordinates(m), tokenizer.layout) for m in made]
            rows.append({**quality(clips, joints), "seconds": seconds})
        out[f"{name}, {steps} steps"] = rows
        console.print(f"{name}, {steps} steps: {np.mean([r['seconds'] for r in rows]):.1f} s a repeat")
    return out


def transitions(run: Path, count: int, sampling: SamplingConfig) -> dict[str, Any]:
    """Percentiles at borders, near them and skating: of scripts with bridges, of the same tokens all decoded,
    and of the segments made apart and joined.
    """
    stages, shelf = finished_stages(run), Shelf()
    dataset = shelf.get(stages["data"]).split("test")
    ude = stages["ude"]
    every = replace(ude, config=ude.config.model_copy(update={"bridge_frames": 0}))
    bundles = {"bridged": Bundle([ude], shelf), "every token": Bundle([every], shelf)}
    bundle = bundles["every token"]
    fps, unit = dataset.layout.fps, bundle.generator.unit_frames / dataset.layout.fps
    clips = dances_of(dataset, count, unit=GROUP_FRAMES)
    truths = [truth_of(dataset, i) for i in spread(dataset, 6 * count)]
    said = [t.caption for t in truths if t.truth and t.truth.get("action") != "dance"]
    out: dict[str, dict[str, list[float]]] = {
        name: {f"{kind}, {near}": [] for near in REACH for kind in ("acceleration", "root velocity")}
        | {"skating": []}
        for name in (*bundles, "joined")
    }
    for k, clip in enumerate(clips):
        lengths = [round(s / unit) * unit for s in (3.0, clip.seconds, 3.0)]
        prompts = [Prompt(said[2 * k]), Prompt(sound=clip.sound, music=clip.music), Prompt(said[2 * k + 1])]
        segments = [DrivenSegment(p, s, "") for p, s in zip(prompts, lengths, strict=True)]
        borders = np.cumsum([round(s * fps) for s in lengths])[:-1].tolist()
        made = {
            name: one.perform(segments, seed=k, sampling=sampling)[0].joints for name, one in bundles.items()
        }
        apart = [
            bundle.perform([segment], seed=100 * k + n, sampling=sampling)[0]
            for n, segment in enumerate(segments)
        ]
        made["joined"] = joints_of(np.concatenate([m.features for m in apart]), dataset.layout)
        for name, joints in made.items():
            for near, reach in REACH.items():
                found = transition_percentiles(joints, borders, fps, reach=reach)
                out[name][f"acceleration, {near}"] += found.acceleration.tolist()
                out[name][f"root velocity, {near}"] += found.root_velocity.tolist()
            out[name]["skating"].append(foot_skating(joints, fps))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--samplers", action="store_true")
    parser.add_argument("--transitions", action="store_true")
    parser.add_argument("--clips", type=int, default=30)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--temperature", type=float, default=1.0, help="of scripts")
    parser.add_argument("--top-p", type=float, default=0.9)
    parser.add_argument("--cfg-scale", type=float, default=1.0)
    args = parser.parse_args()
    console, path = Console(width=160), args.run / "decoding.json"
    found: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
    if args.samplers:
        found["samplers"] = samplers(args.run, args.clips, args.repeats, console)
        names = list(found["samplers"]["recorded"][0])
        table = Table("", *names, "seconds", title=f"True tokens of {args.clips} dances, decoded")
        for title, rows in found["samplers"].items():
            cells = [[row[n] for row in rows if n in row] for n in (*names, "seconds")]
            table.add_row(title, *(f"{np.mean(c):.3f} ± {np.std(c):.3f}" if c else "" for c in cells))
        console.print(table)
    if args.transitions:
        sampling = SamplingConfig(temperature=args.temperature, top_p=args.top_p, cfg_scale=args.cfg_scale)
        found["transitions"] = transitions(args.run, args.clips, sampling)
        keys = [key for key in next(iter(found["transitions"].values())) if key != "skating"]
        table = Table("", *keys, "foot skating", title="mean percentile, share within the 95th")
        for name, figures in found["transitions"].items():
            cells = []
            for key in keys:
                values = np.array(figures[key])
                cells.append(f"{values.mean():.2f}, {(values <= 0.95).mean():.2f}")
            table.add_row(name, *cells, f"{np.mean(figures['skating']):.3f}")
        console.print(table)
    path.write_text(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
