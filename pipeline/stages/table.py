"""The stage kinds of the two papers, by module; one is imported when a kind of it is used."""

from __future__ import annotations

from motionloom.datasets.base.register import declare

_STAGES = "motionloom.pipeline.stages"
_KINDS = {
    "data.data": ("synth", "shards"),
    "data.mix": ("mix",),
    "data.features": ("audio",),
    "data.prepare": ("stats", "text"),
    "networks.tokenizer": ("h2vq", "vq", "rvq", "separate", "fsq", "mq"),
    "networks.tokens": ("tokens",),
    "networks.tma": ("tma",),
    "networks.gpt": ("gpt",),
    "networks.evaluator": ("evaluator",),
    "networks.guo_evaluator": ("guo_evaluator",),
    "networks.dmd": ("dmd",),
    "networks.utt": ("utt",),
    "networks.ude": ("ude",),
    "results.evaluate": ("evaluate",),
    "results.evaluate_dances": ("evaluate_dances",),
    "results.generate": ("generate",),
    "results.report": ("report",),
}
"""Module -> the kinds that it registers."""

declare(
    "stage kind",
    {name: f"{_STAGES}.{module}" for module, names in _KINDS.items() for name in names},
    # A kind for each converter, and for each modality that has features.
    others=[f"{_STAGES}.data.convert", f"{_STAGES}.data.features"],
)
