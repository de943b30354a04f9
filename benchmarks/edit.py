"""How well clips are edited: gaps filled and pins met, beside what needs no model.

    python benchmarks/edit.py work inbetween second third --record edit
    python benchmarks/edit.py work_real inbetween second third --real clips --record edit_real --card

Test clips are made here, from the data settings of the recipe, or are the middle five seconds of BVH files.
Of each the middle 40 % is taken away and made again: by the model, along straight lines, along splines
through all that is kept, and as the training clip whose figure is nearest at both ends of the gap, laid
between them. Then the model fills the same gap with the left wrist pinned in its middle. And all after the
gap's begin does what the words of another test clip say, by the rules that judge synthetic clips; beside the
clip as it was.

Intervals of a row are over three draws, each of another training where several models are given; differences
between rows are over clips. What is measured is kept in the folder `work`, so that a killed run goes on.
`--card` writes the card of the first model.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from bench import Column, arguments, command_line, kept, made_by, making, report
from model_card import test_clips, truth_from
from numpy.typing import NDArray
from results import page, read_records

from motionloom.datasets.actions.measure import agrees
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.resting_hands import with_resting_hands
from motionloom.datasets.motion.canonical import ground, heading, resample
from motionloom.datasets.motion.easing import eased
from motionloom.datasets.motion.features.joints import local_joints_of
from motionloom.datasets.synth.generate import SynthConfig, make_sample, split_of
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.editing.edit import edit_clip
from motionloom.pipeline.editing.finish import accelerations, sliding
from motionloom.pipeline.editing.landing import landed
from motionloom.pipeline.editing.task import EditTask
from motionloom.pipeline.evaluation.estimate import estimate
from motionloom.pipeline.evaluation.truth import Truth
from motionloom.pipeline.inference.clip_file import RecordedClip, read_clip
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.shipped_models import CARD_FIGURES, model_folder
from motionloom.pipeline.runs.recipe import load_recipe

RECIPE = "humantomato-inbetween"
TRAINING = 300
"""Training clips among which the nearest is looked for."""
TRIED = 5
"""Test clips that were looked at while seams were mended, and are not measured."""
GAP = (0.3, 0.7)
DRAWS = 3
SECONDS = 5.0
"""As long as training clips can be."""
MODEL = "**the model**"
LINES = "straight lines"
NEAREST = f"nearest of {TRAINING} training clips"
OTHER_WORDS = "other words from the gap on"
CARD = model_folder(Path("inbetween")) / "README.md"
COLUMNS = (
    Column("from the recording, cm", "away"),
    Column("largest acceleration at a seam, m/s²", "seams"),
    Column("acceleration inside, m/s²", "inside"),
    Column("slower foot, cm/s", "sliding"),
    Column("pin missed by, cm", "pin"),
    Column("other action done, %", "action", 0, 100),
    Column("of what the words ask, %", "words", 0, 100),
)
Joints = NDArray[np.float64]


def measured(joints: Joints, clip: Joints, fps: float, gap: slice) -> dict[str, float]:
    """Figures of a filled gap, beside the clip as it was."""
    size = accelerations(joints, fps)
    steps = np.arange(len(joints) - 1)
    around = [edge + k for edge in (gap.start, gap.stop) for k in range(-3, 1)]
    return {
        "away": 100 * float(np.linalg.norm(joints[gap] - clip[gap], axis=-1).mean()),
        "seams": float(size[around].max()),
        "inside": float(size[gap.start + 2 : gap.stop - 4].mean()),
        "sliding": sliding(joints, fps, (steps >= gap.start - 1) & (steps < gap.stop)),
    }


def straight(clip: Joints, gap: slice) -> Joints:
    out = clip.copy()
    share = np.linspace(0, 1, gap.stop - gap.start + 2)[1:-1, None, None]
    out[gap] = clip[gap.start - 1] * (1 - share) + clip[gap.stop] * share
    return out


def splined(clip: Joints, gap: slice) -> Joints:
    from scipy.interpolate import CubicSpline

    frames = np.r_[0 : gap.start, gap.stop : len(clip)]
    out = clip.copy()
    out[gap] = CubicSpline(frames, clip[frames])(np.arange(gap.start, gap.stop))
    return out


def nearest(clip: Joints, gap: slice, fps: float, training: Sequence[Joints]) -> Joints:
    """The stretch of a training clip whose figure is nearest to the clip's at both ends, laid between."""
    size = gap.stop - gap.start + 1
    ends = local_joints_of(clip, fps)[[gap.start - 1, gap.stop]]
    best = (np.inf, clip)
    for other in training:
        local = local_joints_of(other, fps)
        if len(local) > size:
            off = np.linalg.norm(local[:-size] - ends[0], axis=-1).mean(1)
            off += np.linalg.norm(local[size:] - ends[1], axis=-1).mean(1)
            start = int(off.argmin())
            if off[start] < best[0]:
                best = (float(off[start]), other[start : start + size + 1])
    found = best[1]
    known = np.zeros(size + 1, dtype=bool)
    known[[0, -1]] = True
    angle = heading(found, fps)
    place = ground(found[:, 0])
    wanted = heading(clip, fps)
    there = ground(clip[:, 0])
    turn = np.zeros(size + 1)
    move = np.zeros(size + 1, dtype=np.complex128)
    turn[[0, -1]] = wanted[[gap.start - 1, gap.stop]] - angle[[0, -1]]
    move[[0, -1]] = there[[gap.start - 1, gap.stop]] - place[[0, -1]]
    out = clip.copy()
    laid, _ = landed(found, angle, eased(move, known), eased(turn, known))
    out[gap] = laid[1:-1]
    return out


def obeyed(joints: Joints, words: Truth, fps: float, start: int) -> dict[str, float]:
    """Whether the frames from `start` on do the words' action, and which share of all that these ask."""
    found = agrees(words.truth or {}, joints[start:], None, fps)
    return {"action": float(found["action"]), "words": float(np.mean(list(found.values())))}


def asked_of(clip: Joints, fps: float, gap: slice, words: Truth) -> dict[str, dict[str, object]]:
    """The requests to the model, by the row's title."""
    keep = [{"end": gap.start / fps}, {"start": gap.stop / fps}]
    middle = (gap.start + gap.stop) // 2
    aim = clip[middle, 20] + [0.05, 0.1, 0.1]  # a hand's breadth from where the wrist was
    pin = {"at": middle / fps, "joint": "left_wrist", "position": [float(value) for value in aim]}
    out: dict[str, dict[str, object]] = {MODEL: {"keep": keep}}
    out[OTHER_WORDS] = {
        "keep": keep[:1],
        "caption": words.caption,
        "seconds": (gap.start + len(words.joints)) / fps,
    }
    return out | {"pinned, exact at the end": {"keep": keep, "pins": [pin]}}


def figures_of(
    models: Sequence[MotionModel], clip: RecordedClip, task: dict[str, object], gap: slice, words: Truth
) -> list[dict[str, float]]:
    """Figures of each draw of a task; none where the clip does not allow it, such as a pin out of reach."""
    fps = models[0].fps
    out = []
    drawing = SamplingConfig()
    asked = EditTask.parse(task, "task")
    try:
        draws = [
            edit_clip(models[draw % len(models)].bundle, clip, asked, 1, draw, drawing)
            for draw in range(DRAWS)
        ]
    except UserError:
        return []
    for (made,) in draws:
        near = made.report
        if "seconds" in task:  # as long as the words' own clip, not the recording
            figures = {"sliding": near.sliding, **obeyed(made.joints, words, fps, gap.start)}
        else:
            figures = measured(made.joints, clip.joints, fps, gap)
        if "pins" in task:
            figures["pin"] = float(np.mean(list(near.pins_cm.values())))
        out.append({name: value for name, value in figures.items() if np.isfinite(value)})
    return out


def rows_of(
    models: Sequence[MotionModel],
    clips: Sequence[RecordedClip],
    words: Sequence[Truth],
    training: Sequence[Joints],
    work: Path,
) -> list[dict[str, object]]:
    """The rows of the record: of the model one value a draw, its mean over the clips."""
    fps = models[0].fps
    rivals: dict[str, Callable[[Joints, slice], Joints]] = {
        "recorded": lambda clip, gap: clip,
        LINES: straight,
        "splines": splined,
        NEAREST: lambda clip, gap: nearest(clip, gap, fps, training),
    }
    found: dict[str, list[list[dict[str, float]]]] = {}
    for clip, others in zip(clips, words, strict=True):
        gap = slice(*(round(share * len(clip.joints)) for share in GAP))
        for title, rival in rivals.items():
            figures = measured(rival(clip.joints, gap), clip.joints, fps, gap)
            if title == "recorded":
                figures |= obeyed(clip.joints, others, fps, gap.start)
            found.setdefault(title, []).append([figures])
        for title, task in asked_of(clip.joints, fps, gap, others).items():
            name = re.sub(r"\W+", "_", f"{Path(clip.name).stem}{title}")
            found.setdefault(title, []).append(
                kept(work / f"{name}.json", partial(figures_of, models, clip, task, gap, others))
            )
    away = {title: np.array([[one.get("away", np.nan) for one in draws] for draws in found[title]]).T
            for title in (MODEL, LINES, NEAREST)}  # fmt: skip
    rows: list[dict[str, object]] = []
    for title, each in found.items():
        done = [draws for draws in each if draws]
        cells = {
            name: [
                float(np.nanmean([draws[k].get(name, np.nan) for draws in done])) for k in range(len(done[0]))
            ]
            for name in (column.figure for column in COLUMNS)
            if any(name in one for draws in done for one in draws)
        }
        protocol: dict[str, object] = {"clips": len(done)}
        if title == MODEL:
            for other in (LINES, NEAREST):
                nearer = estimate(away[other] - away[MODEL])
                protocol[f"nearer than {other} by, cm"] = f"{nearer.value:.1f} ± {nearer.interval or 0:.1f}"
        seeds = list(range(DRAWS)) if len(done[0]) > 1 else []  # what needs no model has no draws
        rows.append({"title": title, "cells": cells, "seeds": seeds, "protocol": protocol})
    return rows


def on_the_floor(clip: RecordedClip, fps: float) -> RecordedClip:
    """Its middle at the model's frame rate, the floor at height 0, hands at rest where there are none."""
    joints = resample(clip.joints, clip.fps, fps)
    start = max(0, len(joints) - round(SECONDS * fps)) // 2
    joints = joints[start : start + round(SECONDS * fps)]
    joints = joints if clip.has_hands else with_resting_hands(joints)
    joints[..., 1] -= joints[..., 1].min()
    face = None if clip.face is None else clip.face[: len(joints)]
    return RecordedClip(clip.name, joints, fps, face)


def training_of(config: SynthConfig, count: int) -> list[Joints]:
    train = [index for index in range(config.clips) if split_of(index, config) == "train"]
    chosen = np.random.default_rng(0).permutation(len(train))[:count]
    return [truth_from(make_sample(train[k], config), config).joints for k in chosen]


def write_card(model: Path, title: str, description: str, config: SynthConfig, run: Path | None) -> None:
    """The card of the shipped model: tables of the records, size, and how the run made these weights."""
    records = read_records()
    size = sum(path.stat().st_size for path in model.rglob("*") if path.is_file()) / 1e6
    text = page(CARD.read_text(encoding="utf-8"), records)
    text = re.sub(r"[\d.]+ MB", f"{size:.1f} MB", text)
    noted = (
        json.loads((model / CARD_FIGURES).read_text(encoding="utf-8"))
        if (model / CARD_FIGURES).is_file()
        else {}
    )
    made = making(run) if run else noted.get("made", {})
    text = text.rpartition("```\n")[0] + "```\n" + (f"\n{made_by(made)}" if made else "")
    (model / "README.md").write_text(text, encoding="utf-8")
    actions = ", ".join(name for name in config.action_names if name != "then")
    facts = {
        "name": title,
        "description": f"{description}; it knows {actions}",
        "recipe": RECIPE,
        "made": made,
    }
    (model / CARD_FIGURES).write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("work", type=Path, help="folder of what is measured")
    parser.add_argument("models", type=Path, nargs="+", help="exported folders, or models of the package")
    parser.add_argument("--real", type=Path, help="folder of BVH files, in place of synthetic test clips")
    parser.add_argument("--clips", type=int, default=60, help="synthetic test clips")
    parser.add_argument(
        "--run", type=Path, help="the run of the first model, whose days and steps the card notes"
    )
    parser.add_argument("--card", action="store_true", help="write the model's card from its records")
    args = arguments(parser)
    models = [MotionModel(path, "cpu") for path in args.models]
    recipe = load_recipe(RECIPE)
    files = sorted(args.real.glob("*.bvh")) if args.real else []
    wanted = len(files) if args.real else args.clips
    truths, config = test_clips(recipe, TRIED + 2 * wanted)
    words = truths[TRIED : TRIED + wanted]
    truths = truths[TRIED + wanted :]
    fps = models[0].fps
    clips = [RecordedClip(truth.id, truth.joints, fps, truth.face) for truth in truths]
    if args.real:
        clips = [read_clip(path) for path in files]
    clips = [on_the_floor(clip, fps) for clip in clips]
    if not clips:
        raise UserError("no clips to edit")
    rows = rows_of(models, clips, words, training_of(config, TRAINING), args.work)
    kind = "recorded clips" if args.real else "synthetic test clips"
    report(f"Gaps in {kind}, filled; {recipe.name}", COLUMNS, rows, args.record)
    if args.card:
        write_card(model_folder(args.models[0]), args.models[0].name, recipe.description, config, args.run)


if __name__ == "__main__":
    main()
