"""Metrics of single motions: a metric is a function of one `Performance`, and a `ClipMetric` here.

Each is measured of generated motion and of every reference baseline, and is a mean over clips.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.actions.dances import measure_dance
from motionloom.datasets.actions.measure import agrees
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.register import Table, register
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.models.metrics.dance import SHORTEST, foot_contact_score, foot_skating, physics
from motionloom.models.metrics.dance_beats import DEFINITIONS, beat_align
from motionloom.models.metrics.position import KINDS, position_errors
from motionloom.pipeline.contract.units import Row
from motionloom.pipeline.evaluation.estimate import row_estimates, weighted
from motionloom.pipeline.evaluation.figures import Estimate, Figure, Metric, Protocol, group_figures

Joints = NDArray[np.float64]
Of = Literal["captions", "dances"]

MIN_FRAMES = 4
"""Shortest dance whose figures are taken."""


@dataclass(frozen=True)
class Performance:
    """A motion, and what it is held against."""

    joints: Joints
    """[T, N, 3] in metres."""
    recorded: Joints
    """The motion recorded for the same caption or song."""
    fps: float
    face: NDArray[np.float32] | None = None
    """Expression values [T, 50]."""
    truth: Mapping[str, Any] | None = None
    """Attributes that a synthetic clip is known to have (`ClipMeta.truth`)."""
    beats: NDArray[np.float64] | None = None
    """Seconds of the beats of the music."""

    @property
    def frames(self) -> int:
        """Frames that both motions last."""
        return min(len(self.joints), len(self.recorded))


@dataclass(frozen=True)
class ClipMetric:
    """A function of one motion, and the table and columns of its values."""

    name: str
    """Title of its table, unlike that of any other metric."""
    measure: Callable[[Performance], Row]
    """Values by the names of the columns, each a float or `weighted`, such as by frames; what a motion does
    not show is left out."""
    columns: tuple[Metric, ...]
    """Names of its values, each with a name like `feet.skating` that no other metric has."""
    of: tuple[Of, ...] = ("captions", "dances")
    """Measured of motions for captions (`evaluate`), of dances to music (`evaluate_dances`), or of both."""


CLIP_METRICS: Table[ClipMetric] = Table(ClipMetric, "clip metric")


def _require_own_columns(metric: ClipMetric) -> None:
    taken = {column.name for other in CLIP_METRICS.values() for column in other.columns}
    for column in metric.columns:
        if column.name in taken:
            raise UserError(
                f"clip metric '{metric.name}': another one has a column '{column.name}'; choose a new name"
            )


CLIP_METRICS.follow(_require_own_columns)


def agreement(performance: Performance) -> Row:
    """1 or 0 for each attribute of a synthetic clip's caption that geometry measures, and for all."""
    if performance.truth is None or "action" not in performance.truth:
        return {}
    agreeing = agrees(performance.truth, performance.joints, performance.face, performance.fps)
    agreeing["everything"] = all(agreeing.values())
    return {f"agreement.{name}": float(value) for name, value in agreeing.items()}


def position(performance: Performance) -> Row:
    """APE in m, weighted by frames, and AVE in m², over the frames that both motions last."""
    frames = performance.frames
    if frames < 2:
        return {}
    pair = (performance.joints, performance.recorded)
    generated, real = (torch.from_numpy(np.ascontiguousarray(x[:frames, :BODY_JOINTS])) for x in pair)
    errors = position_errors(generated, real)
    out = Row()
    for kind in KINDS:
        out |= weighted(f"position.ape_{kind}", errors.ape[kind] * frames, frames)
        out[f"position.ave_{kind}"] = errors.ave[kind]
    return out


def floor_and_jerk(performance: Performance) -> Row:
    """Skating, floating, penetration and jitter; nothing of a motion too short for them."""
    if len(performance.joints) < SHORTEST:
        return {}
    values = physics(performance.joints, performance.fps)._asdict()
    return {f"physics.{name}": value for name, value in values.items()}


def beat_alignment(performance: Performance) -> Row:
    """Beat Align by every public definition; nothing of music without a beat."""
    frames = performance.frames
    fps = performance.fps
    if performance.beats is None or frames < MIN_FRAMES:
        return {}
    # The last step has no place of its own in every definition.
    inside = performance.beats[performance.beats < (frames - 1) / fps - 1e-6]
    if not len(inside):
        return {}
    joints = performance.joints[:frames, :BODY_JOINTS]
    return {f"beat_align.{name}": beat_align(joints, inside, fps, name) for name in DEFINITIONS}


def recognition(performance: Performance) -> Row:
    """Whether a dance has its true genre, style and tempo (within 5 %), and |tempo / true tempo - 1|."""
    truth = performance.truth or {}
    if not truth.get("genre") or performance.frames < MIN_FRAMES:
        return {}
    dance = measure_dance(performance.joints[: performance.frames], performance.fps)
    off = abs(dance.bpm / float(truth["bpm"]) - 1)
    return {
        "recognition.genre": float(dance.genre == truth["genre"]),
        "recognition.style": float(dance.style == truth["style"]),
        "recognition.tempo": float(off <= 0.05),
        "recognition.tempo_error": off,
    }


def feet(performance: Performance) -> Row:
    """Share of sliding steps, and EDGE's physical foot contact score."""
    if len(performance.joints) < MIN_FRAMES:
        return {}
    return {
        "feet.skating": foot_skating(performance.joints, performance.fps),
        "feet.contact": foot_contact_score(performance.joints, performance.fps),
    }


_ASPECTS = (
    "everything", "action", "direction", "side", "count", "speed", "left_hand", "right_hand", "face", "style",
    "genre", "bpm",
)  # fmt: skip
BEAT_ALIGN = ClipMetric(
    "Beat Align (higher is better)",
    beat_alignment,
    (
        Metric("beat_align.bailando", "bailando = ude = edge", "higher"),
        Metric("beat_align.mint", "mint", "higher"),
    ),
    of=("dances",),
)
RECOGNITION = ClipMetric(
    "What is danced, measured on the joints (higher is better; the error: lower)",
    recognition,
    (
        Metric("recognition.genre", "genre", "higher"),
        Metric("recognition.style", "style", "higher"),
        Metric("recognition.tempo", "tempo within 5 %", "higher"),
        Metric("recognition.tempo_error", "tempo error", "lower"),
    ),
    of=("dances",),
)
# Tables of figures have them in this order.
for _metric in (
    BEAT_ALIGN,
    RECOGNITION,
    ClipMetric(
        "Distance to the motion recorded for the same caption or song (lower is better)",
        position,
        tuple(
            Metric(f"position.{error}_{kind}", f"{error.upper()} {title}".strip(), "lower", unit)
            for kind, title in (("joints", ""), ("root", "root"), ("path", "path"), ("pose", "pose"))
            for error, unit in (("ape", "m"), ("ave", "m²"))
        ),
    ),
    ClipMetric(
        "Feet, floor and jerk (the nearer to recorded motion, the better)",
        floor_and_jerk,
        (
            Metric("physics.skating", "foot skating"),
            Metric("physics.floating", "floating", unit="mm"),
            Metric("physics.penetration", "penetration", unit="mm"),
            Metric("physics.jitter", "jitter, 100 m/s³"),
        ),
        of=("captions",),
    ),
    ClipMetric(
        "Does the motion do what its caption says? (measured on the joints)",
        agreement,
        tuple(Metric(f"agreement.{name}", name.replace("_", " "), "higher", "share") for name in _ASPECTS),
        of=("captions",),
    ),
    ClipMetric(
        "Feet (lower is better)",
        feet,
        (
            Metric("feet.skating", "foot skating", "lower"),
            Metric("feet.contact", "foot contact score", "lower"),
        ),
        of=("dances",),
    ),
):
    register(_metric)


def metrics_of(what: Of) -> list[ClipMetric]:
    """The metrics of motions for captions, or of dances."""
    return [metric for metric in CLIP_METRICS.values() if what in metric.of]


def measure_clip(metrics: Sequence[ClipMetric], performance: Performance) -> Row:
    """All values of one motion."""
    out = Row()
    for metric in metrics:
        out |= metric.measure(performance)
    return out


def clip_figures(
    metrics: Sequence[ClipMetric], rows: Mapping[str, Sequence[Sequence[Row]]], protocol: Protocol
) -> list[Figure]:
    """Figures of what was measured clip by clip: row -> repeats -> clips (`measure_clip`)."""
    estimates: dict[str, dict[str, Estimate]] = {row: row_estimates(repeats) for row, repeats in rows.items()}
    return [
        figure
        for metric in metrics
        for figure in group_figures(metric.name, metric.columns, estimates, protocol)
    ]
