"""The figures of `metrics.json` and `dances.json` as tables that can be ranked: which of them is better how.

The words and the choice of figures are those of the report's tables (`evaluation/figure_rows.py`,
`stages/evaluate_dances.py`); what each means stands in docs/evaluation.md. Figures that a model should have
like recorded motion, such as Diversity, are shown and not ranked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from motionloom.pipeline.render.labels import label

Better = Literal["lower", "higher", ""]
Form = Literal["mm", "percent", "plain"]
SUBJECT = ""
"""The row of the run itself; the others are references."""


@dataclass(frozen=True)
class Figure:
    """A mean, with the half-width of its 95 % interval where it was repeated."""

    mean: float
    half_width: float = 0.0

    @staticmethod
    def of(value: Any) -> Figure | None:
        """Of a number, or of a mean with its interval; None of anything else."""
        if isinstance(value, Mapping) and isinstance(value.get("mean"), int | float):
            return Figure(float(value["mean"]), float(value.get("half_width", 0.0)))
        if isinstance(value, int | float) and not isinstance(value, bool):
            return Figure(float(value))
        return None

    def text(self, form: Form) -> str:
        """For people."""
        if form == "percent":
            return f"{100 * self.mean:.0f} %"
        mean, half = (_number(value, form) for value in (self.mean, self.half_width))
        return f"{mean} ± {half}" if self.half_width else mean


@dataclass(frozen=True)
class Measure:
    """A column: its title, which direction is better ("" where none is), and how it is written."""

    title: str
    better: Better = ""
    form: Form = "plain"


Row = dict[str, Figure]
"""Figures by the title of their column."""


@dataclass(frozen=True)
class TableSpec:
    """One table of one kind of evaluation."""

    title: str
    kind: str
    columns: tuple[Measure, ...]
    references: Mapping[str, str]
    """Rows that are compared with: key and title."""
    paths: Mapping[str, Mapping[str, Sequence[str]]]
    """Row -> column -> where it lies in the file."""
    protocol: tuple[str, ...] = field(default=())
    """Which facts must be equal for two runs to be ranked: see `protocol_of`."""

    def rows(self, figures: Mapping[str, Any]) -> dict[str, Row]:
        """What a file has of it, by row; no row without a figure."""
        out = {}
        for row, columns in self.paths.items():
            found = {title: Figure.of(_at(figures, path)) for title, path in columns.items()}
            there = {title: figure for title, figure in found.items() if figure is not None}
            if there:
                out[row] = there
        return out


def _at(data: Any, path: Sequence[str]) -> Any:
    for key in path:
        if not isinstance(data, Mapping) or key not in data:
            return None
        data = data[key]
    return data


def _number(value: float, form: Form) -> str:
    if form == "mm":
        return f"{value:.1f}"
    return f"{value:.4g}" if abs(value) >= 100 else f"{value:.3f}"


def _reconstruction(title: str, names: Mapping[str, str]) -> TableSpec:
    references = {"nearest_train_clip": "nearest training clip", "mean_pose": "mean pose"}
    paths: dict[str, dict[str, Sequence[str]]] = {
        row: {title: ("reconstruction_mm", f"{key}_{row}" if row else key) for key, title in names.items()}
        for row in (SUBJECT, *references)
    }
    columns = tuple(Measure(title, "lower", "mm") for title in names.values())
    paths[SUBJECT]["bit/s"] = ("bits_per_second",)
    return TableSpec(title, "evaluate", (*columns, Measure("bit/s")), references, paths, ("reconstructed",))


def _retrieval(title: str, place: tuple[str, ...]) -> TableSpec:
    names = {
        "t2m_r1": "text to motion R@1",
        "t2m_r3": "text to motion R@3",
        "m2t_r1": "motion to text R@1",
        "m2t_r3": "motion to text R@3",
        "matching_score": "TMA-Matching score",
    }
    paths: dict[str, dict[str, Sequence[str]]] = {
        row: {title: ("retrieval", *place, key, name) for name, title in names.items()}
        for row, key in ((SUBJECT, "generated"), ("real", "real"))
    }
    paths["chance"] = {
        title: ("retrieval", *place, "chance", name.partition("_")[2])
        for name, title in names.items()
        if name != "matching_score"
    }
    if not place:
        for row, key in ((SUBJECT, "generated"), ("real", "real")):
            for k in (1, 5):
                paths[row][f"own caption top-{k}"] = ("retrieval", key, f"top-{k}")
    titles = dict.fromkeys(title for columns in paths.values() for title in columns)
    columns = tuple(Measure(t, "lower" if t == names["matching_score"] else "higher") for t in titles)
    references = {"real": "recorded motion", "chance": "chance"}
    return TableSpec(title, "evaluate", columns, references, paths, (*_GENERATED, "retrieval"))


def _grouped(
    title: str,
    kind: str,
    root: tuple[str, ...],
    subject: str,
    references: Mapping[str, str],
    columns: Mapping[tuple[str, ...], Measure],
    protocol: tuple[str, ...],
) -> TableSpec:
    """A table whose rows all lie below `root`."""
    paths = {
        row: {measure.title: (*root, row or subject, *path) for path, measure in columns.items()}
        for row in (SUBJECT, *references)
    }
    return TableSpec(title, kind, tuple(columns.values()), references, paths, protocol)


_GENERATED = ("captioned", "lengths", "caption", "repeats", "evaluator")
_JOINTLY = tuple(name for name in _GENERATED if name != "evaluator")
"""Of what is measured without TMA."""
_DANCED = ("danced", "repeats")
_ASPECTS = (
    "everything", "action", "direction", "side", "count", "speed", "left_hand", "right_hand", "face", "style",
    "genre", "bpm",
)  # fmt: skip
_DANCE_REFERENCES = {
    "ground_truth": "recorded dance",
    "nearest_music": "training dance to the nearest music",
    "random_training_dance": "random training dance",
    "mean_pose": "mean pose, still",
}


def _dance(title: str, columns: Mapping[tuple[str, ...], Measure]) -> TableSpec:
    return _grouped(title, "evaluate_dances", ("rows",), "generated", _DANCE_REFERENCES, columns, _DANCED)


TABLES: tuple[TableSpec, ...] = (
    _reconstruction(
        "Reconstruction as the papers count it, mm (lower is better)",
        {
            f"{metric}{key}": f"{title}{name}"
            for metric, title in (("mpjpe", "MPJPE"), ("pa_mpjpe", "PA-MPJPE"), ("accel", "ACCEL"))
            for key, name in (("", ""), ("_body", ", body"), ("_hand", ", hands"))
        },
    ),
    _reconstruction(
        "Reconstruction with root and heading aligned, and in the world, mm (lower is better)",
        {"pose": "pose", "pose_body": "body", "pose_hand": "fingers from the wrist", "world": "in the world"},
    ),
    TableSpec(
        "Reconstruction of faces (lower is better)",
        "evaluate",
        (Measure("expression error", "lower"),),
        {"mean": "mean expression"},
        {
            SUBJECT: {"expression error": ("reconstruction_face", "expression")},
            "mean": {"expression error": ("reconstruction_face", "expression_mean")},
        },
        ("reconstructed",),
    ),
    _retrieval("TMA-R-Precision of generated motions (higher is better; the score: lower)", ()),
    _retrieval("The same among different captions", ("different_captions",)),
    _grouped(
        "TMA's latents: distance to recorded motions (FID: lower is better) and variety",
        "evaluate",
        ("distribution", "rows"),
        "generated",
        {"recorded": "recorded motion", "training": "training clips", "mean_pose": "mean pose, still"},
        {
            ("fid",): Measure("FID", "lower"),
            ("fid_unit",): Measure("FID, length 1", "lower"),
            ("diversity",): Measure("Diversity"),
            ("multimodality",): Measure("MModality"),
        },
        _GENERATED,
    ),
    _grouped(
        "R-Precision by the evaluator (higher is better; the score: lower)",
        "evaluate",
        ("by_evaluator", "matching"),
        "generated",
        {"real": "recorded motion", "chance": "chance", "mean_pose": "mean pose, still"},
        {
            **{(f"top-{k}",): Measure(f"R-Precision top-{k}", "higher") for k in (1, 2, 3)},
            ("matching_score",): Measure("Matching score", "lower"),
        },
        (*_JOINTLY, "by_evaluator"),
    ),
    _grouped(
        "Faces: R-Precision by the face evaluator (higher is better; the score: lower)",
        "evaluate",
        ("by_face_evaluator", "matching"),
        "generated",
        {"real": "recorded motion", "chance": "chance", "mean_pose": "mean pose, still"},
        {
            **{(f"top-{k}",): Measure(f"R-Precision top-{k}", "higher") for k in (1, 2, 3)},
            ("matching_score",): Measure("Matching score", "lower"),
        },
        (*_JOINTLY, "by_face_evaluator"),
    ),
    _grouped(
        "Distance to the motion recorded for the same caption (lower is better)",
        "evaluate",
        ("positions",),
        "generated",
        {"training": "training clips", "mean_pose": "mean pose, still"},
        {
            ("ape_joints",): Measure("APE, m", "lower"),
            ("ave_joints",): Measure("AVE, m²", "lower"),
            ("ape_root",): Measure("APE root", "lower"),
            ("ave_root",): Measure("AVE root", "lower"),
        },
        _JOINTLY,
    ),
    _grouped(
        "Kinetic (k) and geometric (m) features of movement (FID: lower is better)",
        "evaluate",
        ("movement", "rows"),
        "generated",
        {"recorded": "recorded motion", "training": "training clips", "mean_pose": "mean pose, still"},
        {
            ("fid_k",): Measure("FID_k", "lower"),
            ("fid_m",): Measure("FID_m", "lower"),
            ("div_k",): Measure("Div_k"),
            ("div_m",): Measure("Div_m"),
        },
        _JOINTLY,
    ),
    _grouped(
        "Feet, floor and jerk (the nearer to recorded motion, the better)",
        "evaluate",
        ("physics",),
        "generated",
        {"recorded": "recorded motion"},
        {
            ("skating",): Measure("foot skating"),
            ("floating",): Measure("floating, mm", "", "mm"),
            ("penetration",): Measure("penetration, mm", "", "mm"),
            ("jitter",): Measure("jitter, 100 m/s³"),
        },
        _JOINTLY,
    ),
    _grouped(
        "Does the motion do what its caption says? Measured on the joints (higher is better)",
        "evaluate",
        ("agreement_with_caption",),
        "generated",
        {"truth": "recorded motion"},
        {(name,): Measure(label(name), "higher", "percent") for name in _ASPECTS},
        _JOINTLY,
    ),
    _dance(
        "Beat Align of dances (higher is better)",
        {
            ("beat_align", "ude"): Measure("Beat Align", "higher"),
            ("beat_align", "mint"): Measure("Beat Align (MINT)", "higher"),
            ("way", "ude"): Measure("way to the truth", "higher"),
            ("way", "mint"): Measure("way to the truth (MINT)", "higher"),
        },
    ),
    _dance(
        "What is danced, measured on the joints (higher is better; the error: lower)",
        {
            ("recognition", "genre"): Measure("genre", "higher"),
            ("recognition", "style"): Measure("style", "higher"),
            ("recognition", "tempo"): Measure("tempo within 5 %", "higher"),
            ("recognition", "tempo_error"): Measure("tempo error", "lower"),
        },
    ),
    _dance(
        "Distance to real dances (FID: lower is better) and variety",
        {
            ("distribution", "fid_k"): Measure("FID_k", "lower"),
            ("distribution", "fid_m"): Measure("FID_m", "lower"),
            ("distribution", "div_k"): Measure("Div_k"),
            ("distribution", "div_m"): Measure("Div_m"),
            ("multimodality", "mm_k"): Measure("MM_k"),
            ("multimodality", "mm_m"): Measure("MM_m"),
        },
    ),
    _dance(
        "Feet of dances (lower is better)",
        {
            ("feet", "foot_skating"): Measure("foot skating", "lower"),
            ("feet", "foot_contact"): Measure("foot contact score", "lower"),
        },
    ),
)

HEADLINES = (
    ("MPJPE", "MPJPE, mm"),
    ("text to motion R@1", "text to motion R@1"),
    ("FID", "FID"),
    ("everything", "does all its caption says"),
    ("Beat Align", "Beat Align"),
    ("FID_k", "FID_k"),
)
"""Columns that the terminal shows, and their titles there."""
