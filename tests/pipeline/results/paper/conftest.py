"""Runs written by hand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import run_records as records

VQ = {"net": {"kind": "vq", "part": "bodyhand", "num_codes": 256}}
RVQ = {"net": {"kind": "rvq", "part": "bodyhand", "num_codes": 512, "levels": 2}}
H2VQ = {"net": {"kind": "h2vq", "part": "bodyhand", "num_codes": 512}}
GPT = {"face": False, "prior": "tma", "loss": {"align_weight": 0.1}}


@pytest.fixture
def baselines(tmp_path: Path) -> Callable[..., Path]:
    """`baselines("name", data="synth")`: a run with several tokenizers, generators and evaluations."""

    def make(name: str = "bl", *, data: dict[str, Any] | None = None, judge: str = "a") -> Path:
        def measured(tokenizer: str, mpjpe: float) -> dict[str, Any]:
            return {
                "kind": "evaluate",
                "inputs": {"data": "data", "tokenizer": tokenizer},
                "figures": records.reconstruction(mpjpe),
            }

        def judged(generator: str, fid: float, m2t: float) -> dict[str, Any]:
            return {
                "kind": "evaluate",
                "inputs": {"data": "data", "tma": "tma", f"generators.{generator}": generator},
                "figures": records.by_text(fid, m2t, generator=generator, judge=judge),
            }

        return records.write_run(
            tmp_path / name,
            {
                "data": data or {"kind": "synth", "config": {"clips": 64}},
                "tokenizer": {"kind": "h2vq", "config": H2VQ, "inputs": {"data": "data"}},
                "vq": {"kind": "vq", "config": VQ, "inputs": {"data": "data"}},
                "rvq": {"kind": "rvq", "config": RVQ, "inputs": {"data": "data"}},
                "tma": {"kind": "tma", "config": {"part": "bodyhand", "loss": {"contrastive": 0.1}}},
                "temos": {"kind": "tma", "config": {"part": "bodyhand", "loss": {"contrastive": 0.0}}},
                "gpt": {"kind": "gpt", "config": GPT, "inputs": {"tokenizer": "tokenizer"}},
                "evaluate": measured("tokenizer", 90.0),
                "evaluate_vq": measured("vq", 140.0),
                "evaluate_rvq": measured("rvq", 110.0),
                "evaluate_gpt": judged("gpt", 3.0, 0.5),
                "evaluate_temos": judged("temos", 4.0, 0.25),
            },
        )

    return make
