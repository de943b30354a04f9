"""What DMD's samplers cost and give, and whether scripts change over smoothly: two proofs of a UDE run.

    motionloom run ude-learning
    python benchmarks/ude_decoding.py runs/ude-learning --samplers --transitions

`--samplers`: true tokens of one window of held-out dances decoded by 20 steps of DPM-Solver++, by DDIM and by
all of DDPM's steps, several times each: distance to what was recorded, Beat Align, feet, roughness, seconds.
Differences count against the spread of the repeats.

`--transitions`: scripts of a caption, a song and another caption. At each border the acceleration of the
joints and the speed of the root as percentiles among those inside the segments of the same motion
(`transition_percentiles`), with bridges, with every token decoded, and beside the same segments made
apart and joined; close to the border and so far around it that a bridge is covered; and foot skating.

Writes `decoding.json` into the run's folder.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from motionloom.datasets.motion.features.joints import joints_of, local_joints_of
from motionloom.datasets.schema import UserError
from motionloom.models.diffusion.sampling import decode_motions
from motionloom.models.diffusion.schedule import Sampler
from motionloom.models.gpt.drawing import sample_seeds
from motionloom.models.metrics.dance import foot_skating
from motionloom.models.tokenizer.base import GROUP_FRAMES
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.clip_metrics import Performance, beat_alignment
from motionloom.pipeline.evaluation.dances import DanceClip, dances_of
from motionloom.pipeline.evaluation.truth import spread, truth_of
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.script import DrivenSegment

Joints = NDArray[np.float64]

REACH = {"at the border": 2, "around it": 10}
"""Frames to either side of which the largest figure counts; ten cover a bridge of sixteen."""


Array = NDArray[np.float64]


@dataclass(frozen=True)
class TransitionPercentiles:
    """Of each border [K], how its figures lie among those of the inside: shares, 0 to 1."""

    acceleration: Array
    """Of the joints, mean over them."""
    root_velocity: Array
    """Of the root, in all directions."""


def transition_percentiles(
    joints: NDArray[np.floating], borders: Sequence[int], fps: float, *, reach: int = 2
) -> TransitionPercentiles:
    """How borders compare with the inside of the segments of one motion.

    A border's figure is the largest one within `reach` frames of it **[ours]**, so a jerk that comes a frame
    late counts. The inside is measured alike, by the largest figures of equally long stretches that reach no
    border: else a maximum would be compared with single frames.

    Args:
        joints: [T, N, 3] in metres, joint 0 is the root.
        borders: First frames of the segments from the second on.
        fps: Frames a second; percentiles do not depend on it, it keeps the figures in m/s and m/s^2.
        reach: Frames to either side.
    """
    x = np.asarray(joints, dtype=np.float64)
    frames = len(x)
    if x.ndim != 3 or frames < 3 or reach < 1:
        raise UserError(
            f"transitions need joints [T >= 3, N, 3] and a reach of 1 or more, got {list(x.shape)}, {reach}"
        )
    wrong = [border for border in borders if not 1 <= border < frames]
    if wrong or not len(borders):
        raise UserError(f"borders {list(borders)} of {frames} frames: each must be from 1 to {frames - 1}")
    pull, speed = accelerations(x, fps), root_speeds(x, fps)
    centres = np.arange(reach, frames - reach)
    away = np.abs(centres[:, None] - np.asarray(borders)[None]).min(1)
    inside = centres[away > 2 * reach]
    if not len(inside):
        raise UserError(
            f"borders {list(borders)} of {frames} frames leave no inside {2 * reach} frames away from them"
        )
    return TransitionPercentiles(*(_percentiles(values, borders, inside, reach) for values in (pull, speed)))


def accelerations(joints: NDArray[np.floating], fps: float) -> Array:
    """Mean over the joints of |acceleration| in m/s^2, [T]; the ends repeat their neighbours."""
    second = np.diff(np.asarray(joints, dtype=np.float64), n=2, axis=0) * fps**2
    inner = np.linalg.norm(second, axis=-1).mean(1)
    return np.concatenate([inner[:1], inner, inner[-1:]])


def root_speeds(joints: NDArray[np.floating], fps: float) -> Array:
    """|velocity| of the root in m/s, [T], of the step to each frame; frame 0 repeats frame 1."""
    steps = np.linalg.norm(np.diff(np.asarray(joints, dtype=np.float64)[:, 0], axis=0), axis=-1) * fps
    return np.concatenate([steps[:1], steps])


def _percentiles(values: Array, borders: Sequence[int], inside: NDArray[np.int64], reach: int) -> Array:
    """Mid-ranks: equal values count half, so a motion that never changes is at 0.5."""
    usual = _largest(values, inside, reach)
    found = _largest(values, np.asarray(borders), reach)
    below = (usual[None] < found[:, None]).mean(1)
    equal = (usual[None] == found[:, None]).mean(1)
    return np.asarray(below + equal / 2)


def _largest(values: Array, centres: NDArray[np.int64], reach: int) -> Array:
    """Largest of `values` [T] within `reach` frames of each centre."""
    padded = np.pad(values, reach, constant_values=-np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)
    return np.asarray(windows[centres].max(-1))


def quality(clips: Sequence[DanceClip], made: Sequence[Joints]) -> dict[str, float]:
    """Of one motion a clip."""
    fps = clips[0].fps
    error = [
        np.linalg.norm(local_joints_of(m, fps) - local_joints_of(c.joints, fps), axis=-1).mean()
        for c, m in zip(clips, made, strict=True)
    ]
    found = [
        beat_alignment(Performance(m, c.joints, fps, beats=c.beats)) for c, m in zip(clips, made, strict=True)
    ]
    beats = [row["beat_align.bailando"] for row in found if row]
    return {
        "pose error, mm": 1000 * float(np.mean(error)),
        "Beat Align": float(np.mean(beats)),
        "foot skating": float(np.mean([foot_skating(m, fps) for m in made])),
        "acceleration, m/s2": float(np.mean([accelerations(m, fps).mean() for m in made])),
    }


def samplers(run: Path, count: int, repeats: int, console: Console) -> dict[str, Any]:
    """Sampler -> figures of each repeat."""
    stages, stage_cache = finished_stages(run), StageCache()
    tokenizer, dmd = stage_cache.get(stages["tokenizer"]), stage_cache.get(stages["dmd"])
    dataset = stage_cache.get(stages["data"]).split("test")
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
    stages, stage_cache = finished_stages(run), StageCache()
    dataset = stage_cache.get(stages["data"]).split("test")
    ude = stages["ude"]
    every = replace(ude, config=ude.config.model_copy(update={"bridge_frames": 0}))
    bundles = {"bridged": Bundle([ude], stage_cache), "every token": Bundle([every], stage_cache)}
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
        prompts = [
            Prompt(said[2 * k]),
            Prompt(sound=clip.sound, conditions={"audio": clip.music}),
            Prompt(said[2 * k + 1]),
        ]
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
