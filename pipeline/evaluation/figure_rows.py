"""Tables of what an evaluation by captions found; terminal and report show the same ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from motionloom.pipeline.evaluation.dance_figures import KINETIC
from motionloom.pipeline.evaluation.figures import chance
from motionloom.pipeline.evaluation.paired import POSITION_TITLES
from motionloom.pipeline.render.labels import label

Rows = tuple[str, list[str], list[list[str]]]
"""Title, columns, rows."""


def figure_rows(figures: dict[str, Any]) -> list[Rows]:
    """(title, columns, rows) of each table; the report draws the same ones."""
    out: list[Rows] = []
    if "reconstruction_mm" in figures:
        out += _reconstruction_rows(figures)
    if "reconstruction_face" in figures:
        found = figures["reconstruction_face"]
        titles = {"expression": "expression error", "vertex": "vertices, mm"}
        titles = {key: title for key, title in titles.items() if key in found}
        rows = [
            [title, *(f"{found[key + suffix]:.3f}" for key in titles)]
            for title, suffix in (("tokenizer", ""), ("mean expression", "_mean"))
        ]
        out.append(("Reconstruction of faces (lower is better)", ["", *titles.values()], rows))
    if "reconstruction_latents" in figures:
        out.append(_rebuilt_rows(figures["reconstruction_latents"]))
    if "retrieval" in figures:
        found = figures["retrieval"]
        out.append(_retrieval_rows(found))
        if "top-1" in found["real"]:
            tops = [
                [f"{name} motion", *(_interval(found[name][f"top-{k}"]) for k in (1, 5))]
                for name in ("real", "generated")
            ]
            guess = ["chance", *(f"{min(1.0, chance(k, found['among'])):.3f}" for k in (1, 5))]
            columns = ["", "top-1", "top-5"]
            out.append((f"Own caption among {found['among']}, by TMA", columns, [guess, *tops]))
    if figures.get("distribution", {}).get("rows"):
        out.append(_distribution_rows(figures["distribution"], "TMA's latents"))
    for key, whose in (("by_evaluator", "the evaluator"), ("by_face_evaluator", "the face evaluator")):
        if key in figures:
            out += _evaluator_rows(figures[key], whose)
    if "positions" in figures:
        out += _paired_rows(figures)
    if "physics" in figures:
        found = figures["physics"]
        titles = {"skating": "foot skating", "floating": "floating, mm", "penetration": "penetration, mm"}
        titles["jitter"] = "jitter, 100 m/s³"
        rows = [
            [f"{who} motion", *(f"{row[key]:.3f}" for key in titles)] for who, row in found.items() if row
        ]
        out.append(
            ("Feet, floor and jerk (the nearer to recorded motion, the better)", ["", *titles.values()], rows)
        )
    if "agreement_with_caption" in figures:
        found = figures["agreement_with_caption"]
        names = sorted({*found["truth"], *found["generated"]})
        rows = [[label(n), *(_percent(found[k].get(n)) for k in ("truth", "generated"))] for n in names]
        out.append(
            (
                "Does the motion do what its caption says? (measured on the joints)",
                ["", "real", "generated"],
                rows,
            )
        )
    return out


def _retrieval_rows(found: dict[str, Any]) -> Rows:
    guesses = [f"{found['chance'][f'r{k}']:.3f}" for k in (1, 3)]
    rows = [["chance", *guesses, *guesses, ""]]
    keys = ("t2m_r1", "t2m_r3", "m2t_r1", "m2t_r3", "matching_score")
    for title, part in (("", found), (", different captions", found.get("different_captions"))):
        if part is not None and part["size"] == found["size"]:
            for name in ("real", "generated"):
                rows.append([f"{name} motion{title}", *(_interval(part[name][key]) for key in keys)])
    columns = ["", "text to motion R@1", "R@3", "motion to text R@1", "R@3", "TMA-Matching score"]
    return (
        f"TMA-R-Precision among {found['size']}, {found['clips']} clips as they are drawn",
        columns,
        rows,
    )


def _distribution_rows(found: dict[str, Any], whose: str) -> Rows:
    keys = ("fid", "fid_unit", "diversity", "multimodality")
    titles = {
        "recorded": "recorded motion",
        "training": f"{found['training_clips']} training clips",
        "generated": "generated motion",
        "mean_pose": "mean pose, still",
    }
    rows = [
        [
            title,
            *(_interval(found["rows"][name][key]) if key in found["rows"][name] else "" for key in keys),
        ]
        for name, title in titles.items()
    ]
    columns = ["", "FID", "FID, length 1", "Diversity", "MModality"]
    return f"{whose}: FID to {found['clips']} recorded motions", columns, rows


_JUDGES = {"tma": "TMA", "evaluator": "the evaluator", "face_evaluator": "the face evaluator"}


def _rebuilt_rows(figures: dict[str, Any]) -> Rows:
    rows = []
    for role, found in figures.items():
        cells = [found.get(key) for key in ("fid", "training_fid", "top-3", "recorded_top-3")]
        texts = ["" if c is None else _interval(c) if isinstance(c, dict) else f"{c:.3f}" for c in cells]
        rows.append([f"{_JUDGES.get(role, role)}, {found['clips']} clips", *texts])
    columns = ["latents of", "FID", "as many training clips", "R-Precision top-3", "of recorded motion"]
    return "Reconstructed motion by its latents", columns, rows


def _paired_rows(figures: dict[str, Any]) -> list[Rows]:
    names = {
        "recorded": "recorded motion", "generated": "generated motion", "training": "training clips",
        "mean_pose": "mean pose, still",
    }  # fmt: skip
    out: list[Rows] = []
    found = figures["positions"]
    rows = [
        [title, *(_interval(found[name][key]) for key in POSITION_TITLES)]
        for name, title in names.items()
        if found.get(name)
    ]
    title = "Distance to the motion recorded for the same caption (lower is better)"
    out.append((title, ["", *POSITION_TITLES.values()], rows))
    moves = figures["movement"]
    keys = {f"{name.lower()}_{kind}": f"{name}_{kind}" for name in ("FID", "Div", "MM") for kind in "km"}
    rows = [
        [title, *(_interval(row[key]) if key in row else "" for key in keys)]
        for name, title in names.items()
        if (row := moves["rows"].get(name))
    ]
    title = f"Kinetic (k) and geometric (m) features of {moves['clips']} motions"
    if moves["clips"] < KINETIC:
        title += f"; few for FID, whose features are up to {KINETIC}"
    out.append((title, ["", *keys.values()], rows))
    return out


def _evaluator_rows(figures: dict[str, Any], whose: str) -> list[Rows]:
    found = figures["matching"]
    keys = ("top-1", "top-2", "top-3", "matching_score")
    rows = [["chance", *(f"{found['chance'][key]:.3f}" for key in keys[:3]), ""]]
    for name, title in (
        ("real", "real motion"), ("generated", "generated motion"), ("mean_pose", "mean pose, still"),
    ):  # fmt: skip
        rows.append([title, *(_interval(found[name][key]) for key in keys)])
    title = f"R-Precision among {found['size']} by {whose}, {found['clips']} clips as they are drawn"
    out: list[Rows] = [(title, ["", "top-1", "top-2", "top-3", "Matching score"], rows)]
    if figures["distribution"]["rows"]:
        out.append(_distribution_rows(figures["distribution"], f"{whose[:1].upper()}{whose[1:]}'s latents"))
    return out


def _reconstruction_rows(figures: dict[str, Any]) -> list[Rows]:
    r = figures["reconstruction_mm"]
    answers = (
        ("tokenizer", ""),
        ("nearest training clip", "_nearest_train_clip"),
        ("mean pose", "_mean_pose"),
    )

    def rows(keys: Sequence[str]) -> list[list[str]]:
        return [[title, *(_mm(r[f"{key}{suffix}"]) for key in keys)] for title, suffix in answers]

    parts = [part for part in ("", "_body", "_hand") if f"mpjpe{part}" in r]
    # Of all joints, then of the body's and the hands': narrow enough for a terminal.
    published = [f"{metric}{part}" for metric in ("mpjpe", "pa_mpjpe", "accel") for part in parts]
    names = {"_body": "body", "_hand": "hands"}
    columns = [names.get(part, metric) for metric in ("MPJPE", "PA-MPJPE", "ACCEL") for part in parts]
    ours = {
        "pose": "pose",
        "pose_body": "body",
        "pose_hand": "fingers from the wrist",
        "world": "in the world",
    }
    ours = {key: title for key, title in ours.items() if key in r}
    clips = f"{figures['reconstructed_clips']} {figures['split']} clips"
    return [
        (
            f"Reconstruction of {clips} as the papers count it, mm (lower is better); codes of "
            f"{figures['bits_per_second']:.0f} bit/s",
            ["", *columns],
            rows(published),
        ),
        ("The same with root and heading aligned, and in the world, mm", ["", *ours.values()], rows([*ours])),
    ]


def _mm(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def _percent(value: float | None) -> str:
    return "" if value is None else f"{100 * value:.0f} %"


def _interval(value: dict[str, float]) -> str:
    return f"{value['mean']:.3f} ± {value['half_width']:.3f}"
