"""How figures were measured, and whether two runs' were measured alike.

Figures are ranked only among runs whose facts are equal. What belongs to the model under test is no such
fact **[ours]**: its sampling (temperature, guidance, steps) and the seed of its draws; settings show them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from motionloom.pipeline.compare.runs import FigureFile

UNKNOWN = "unknown"
_WORDS = {
    "version": "by different versions of the evaluation ({values}; evaluate again)",
    "split": "on different splits ({values})",
    "data": "on different clips",
    "number": "on different numbers of clips ({values})",
    "lengths": "with generated motions of different lengths ({values})",
    "caption": "by different captions of a clip ({values})",
    "repeats": "with different numbers of repeats ({values})",
    "size": "among different numbers of candidates ({values})",
    "among": "with the own caption among different numbers ({values})",
    "evaluator": "by different TMA models",
    "by_evaluator": "by different evaluators",
    "by_face_evaluator": "by different evaluators of faces",
    "feature_fps": "at different frame rates ({values})",
    "seconds": "with dances cut to different lengths ({values})",
    "shuffles": "with different numbers of other songs ({values})",
    "pool": "with trivial answers from different numbers of dances ({values})",
}


def protocol_of(file: FigureFile, names: Sequence[str]) -> dict[str, str]:
    """The facts of one evaluation that count for a table: name -> value."""
    figures = file.figures
    said: Mapping[str, Any] = figures.get("protocol") or {}
    retrieval: Mapping[str, Any] = figures.get("retrieval") or {}
    settings = file.settings
    facts: dict[str, Any] = {"version": file.version, "split": figures.get("split")}
    if "reconstructed" in names:
        facts["number"] = figures.get("reconstructed_clips")
        facts["data"] = figures.get("reconstructed_sha256", file.data)
    if "captioned" in names:
        facts["number"] = figures.get("clips")
        facts["data"] = said.get("clips_sha256", file.data)
    if "danced" in names:
        facts["number"], facts["data"] = figures.get("clips"), file.data
        facts["feature_fps"] = figures.get("feature_fps")
        facts |= {name: str(settings.get(name, UNKNOWN)) for name in ("seconds", "shuffles", "pool")}
    if "lengths" in names:
        facts |= {name: said.get(name) for name in ("lengths", "caption")}
    if "repeats" in names:
        facts["repeats"] = said.get("repeats", figures.get("repeats"))
    if "retrieval" in names:
        facts |= {name: retrieval.get(name) for name in ("size", "among")}
    if "evaluator" in names:
        facts["evaluator"] = (said.get("evaluator") or {}).get("sha256")
    for judge in ("by_evaluator", "by_face_evaluator"):
        if judge in names:
            facts[judge] = (said.get(judge) or {}).get("sha256")
            facts["size"] = ((figures.get(judge) or {}).get("matching") or {}).get("size")
    return {name: _text(value) for name, value in facts.items()}


def say_difference(protocols: Mapping[str, Mapping[str, str]]) -> str:
    """How the protocols of runs, by label, differ, in one sentence; nothing where they are equal."""
    parts = []
    for name in dict.fromkeys(name for facts in protocols.values() for name in facts):
        values = {label: facts.get(name, UNKNOWN) for label, facts in protocols.items()}
        if len(set(values.values())) > 1:
            shown = "; ".join(f"{label}: {value}" for label, value in values.items())
            parts.append(_WORDS[name].format(values=shown))
        elif UNKNOWN in values.values():
            parts.append(f"by files that do not say their {_noun(name)}")
    if not parts:
        return ""
    listed = parts[0] if len(parts) == 1 else ", ".join(parts[:-1]) + f" and {parts[-1]}"
    return f"Not all measured alike, so not all ranked: {listed}."


def groups(protocols: Mapping[str, Mapping[str, str]]) -> list[list[str]]:
    """Labels of runs that were measured alike, in order; a protocol that is not known is like no other."""
    out: dict[str, list[str]] = {}
    for label, facts in protocols.items():
        key = json.dumps(sorted(facts.items()))
        out.setdefault(f"{key} {label}" if UNKNOWN in facts.values() else key, []).append(label)
    return list(out.values())


def _noun(name: str) -> str:
    return {
        "data": "clips",
        "number": "number of clips",
        "evaluator": "TMA model",
        "by_evaluator": "evaluator",
        "by_face_evaluator": "evaluator of faces",
    }.get(name, name)


def _text(value: Any) -> str:
    return UNKNOWN if value is None else str(value)
