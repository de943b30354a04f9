"""Answers that need no model, which stand beside every figure that has them and are never ranked.

Where an evaluation writes them is known here alone; `docs/evaluation.md` says what they mean.
"""

from __future__ import annotations

import re

RECORDED = "recorded motion"

TITLES = (
    RECORDED,
    "training clips, as many",
    "nearest training clip",
    "training dance to the nearest music",
    "random training dance",
    "generated dances under other music",
    "mean pose, still",
    "mean expression",
    "chance",
)
"""In the order in which they are shown."""

_JUDGES = ("by_evaluator", "by_face_evaluator")
_LATENTS = {RECORDED: "recorded", "training clips, as many": "training", "mean pose, still": "mean_pose"}
_DANCES = {
    RECORDED: "ground_truth",
    "training dance to the nearest music": "nearest_music",
    "random training dance": "random_training_dance",
    "generated dances under other music": "shuffled_music",
    "mean pose, still": "mean_pose",
}


def answers(figure: str) -> dict[str, str]:
    """Title of an answer -> its key, for the key of a model's figure."""
    first, _, rest = figure.partition(".")
    if first == "reconstruction_mm":
        return {
            "nearest training clip": f"{figure}_nearest_train_clip",
            "mean pose, still": f"{figure}_mean_pose",
        }
    if first == "reconstruction_face":
        return {"mean expression": f"{figure}_mean"}
    if first == "reconstruction_latents":
        where, _, name = figure.rpartition(".")
        if name == "fid":
            return {"training clips, as many": f"{where}.training_fid"}
        return {RECORDED: f"{where}.recorded_{name}", "chance": f"{where}.chance_{name}"}
    if first == "positions":
        key = rest.removeprefix("generated.")
        rows = {"training clips, as many": "training", "mean pose, still": "mean_pose"}
        return {title: f"positions.{row}.{key}" for title, row in rows.items()}
    for where in ("distribution", "movement", *(f"{judge}.distribution" for judge in _JUDGES)):
        if figure.startswith(f"{where}.rows.generated."):
            key = figure.removeprefix(f"{where}.rows.generated.")
            return {title: f"{where}.rows.{row}.{key}" for title, row in _LATENTS.items()}
    if first == "rows" and rest.startswith("generated."):
        key = rest.removeprefix("generated.")
        return {title: f"rows.{row}.{key}" for title, row in _DANCES.items()}
    if first == "agreement_with_caption":
        return {RECORDED: figure.replace(".generated.", ".truth.")}
    if first in _JUDGES and rest.startswith("matching.generated."):
        key = rest.removeprefix("matching.generated.")
        rows = {RECORDED: "real", "mean pose, still": "mean_pose", "chance": "chance"}
        return {title: f"{first}.matching.{row}.{key}" for title, row in rows.items()}
    if first == "retrieval":
        found = re.fullmatch(r"(.*)\.generated\.(?:[tm]2[mt]_)?(.+)", figure)
        real = {RECORDED: figure.replace(".generated.", ".real.")}
        return real | ({"chance": f"{found[1]}.chance.{found[2]}"} if found else {})
    if "/R@" in figure:
        return {"chance": re.sub("t2m|m2t", "guess", figure)}
    return {}
