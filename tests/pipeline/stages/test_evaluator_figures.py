"""The evaluator's figures: on golden latents those of the public code, by the functions `evaluate` calls."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from motionloom.models.metrics import retrieval
from motionloom.pipeline.evaluation.figure_rows import figure_rows
from motionloom.pipeline.evaluation.tables import plain
from motionloom.pipeline.evaluation.text_motion import Latents, distribution, matching


@pytest.fixture(scope="module")
def golden(shared: Path) -> dict[str, torch.Tensor]:
    with np.load(shared / "golden" / "t6_metrics_A.npz", allow_pickle=False) as data:
        return {key: torch.from_numpy(np.asarray(data[key])) for key in data.files}


def latents(golden: dict[str, torch.Tensor]) -> Latents:
    text, real, made = (golden[name] for name in ("text", "gt", "pred"))
    return Latents(text=text, real=real, made=[made], others=made[:300], still=real.mean(0).expand_as(real))


@pytest.mark.parametrize("size", [32, 256])
def test_matching_is_that_of_the_public_code(
    size: int, golden: dict[str, torch.Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The golden batches are in row order, so the draw of batches is taken out."""
    monkeypatch.setattr(retrieval.torch, "randperm", lambda count, **_: torch.arange(count))  # type: ignore[attr-defined]
    found = matching(latents(golden), size=size, repeats=1, seed=0)
    for name, ours in (("pred", "generated"), ("gt", "real")):
        row = found[ours]
        tops = [row[f"top-{k}"].mean for k in (1, 2, 3)]
        assert tops == pytest.approx(golden[f"rprec_{name}_B{size}"].tolist(), rel=1e-5)
        score = golden[f"match_{name}_B{size}"].item()
        assert row["matching_score"].mean == pytest.approx(score, rel=1e-5)
    assert found["chance"] == {f"top-{k}": k / size for k in (1, 2, 3)}
    # Motions that are all alike share all places, so none is among the first.
    assert found["mean_pose"]["top-1"].mean == 0 and found["mean_pose"]["matching_score"].mean > 0


def test_fid_is_that_of_the_public_code(golden: dict[str, torch.Tensor]) -> None:
    rows = distribution(latents(golden), seed=0)["rows"]
    assert rows["generated"]["fid"].mean == pytest.approx(golden["fid_pred_gt_float64"].item(), rel=1e-5)
    assert set(rows) == {"recorded", "training", "generated", "mean_pose"}


def test_tables_show_them(golden: dict[str, torch.Tensor]) -> None:
    both = latents(golden)
    figures: dict[str, Any] = {
        "by_evaluator": {
            "matching": matching(both, size=32, repeats=2, seed=0),
            "distribution": distribution(both, seed=0),
        }
    }
    first, second = figure_rows(plain(figures))
    assert first[0] == "R-Precision among 32 by the evaluator, 600 clips as they are drawn"
    assert first[1] == ["", "top-1", "top-2", "top-3", "Matching score"]
    assert [row[0] for row in first[2]] == ["chance", "real motion", "generated motion", "mean pose, still"]
    assert first[2][0][1:] == ["0.031", "0.062", "0.094", ""]
    assert second[0] == "The evaluator's latents: FID to 600 recorded motions"
    assert [row[0] for row in second[2]][1] == "300 training clips"
