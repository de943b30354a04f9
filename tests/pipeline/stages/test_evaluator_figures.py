"""The evaluator's figures: on golden latents those of the public code, by the functions `evaluate` calls."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from motionloom.models.metrics import retrieval
from motionloom.pipeline.evaluation.figures import CHANCE, MODEL, RECORDED, STILL, TRAINING, FigureFile
from motionloom.pipeline.evaluation.latent_metrics import Latents, judged_figures


@pytest.fixture(scope="module")
def golden(shared: Path) -> dict[str, torch.Tensor]:
    with np.load(shared / "golden" / "t6_metrics_A.npz", allow_pickle=False) as data:
        return {key: torch.from_numpy(np.asarray(data[key])) for key in data.files}


def latents(golden: dict[str, torch.Tensor]) -> Latents:
    text, real, made = (golden[name] for name in ("text", "gt", "pred"))
    return Latents(text=text, real=real, made=[made], others=made[:300], still=real.mean(0).expand_as(real))


def judged(golden: dict[str, torch.Tensor], size: int) -> FigureFile:
    """Figures by an evaluator that embeds the golden captions and motions."""
    both, count = latents(golden), len(golden["text"])
    words = [str(row) for row in range(count)]
    figures = judged_figures(
        "evaluator", "the evaluator", both, words, {"clips": count}, size=size, among=2, seed=0
    )
    return FigureFile("evaluate", tuple(figures))


def value(found: FigureFile, name: str, row: str = MODEL) -> float:
    figure = found.of(f"evaluator.{name}", row)
    assert figure is not None, name
    return figure.value


@pytest.mark.parametrize("size", [32, 256])
def test_matching_is_that_of_the_public_code(
    size: int, golden: dict[str, torch.Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The golden batches are in row order, so the draw of batches is taken out."""
    monkeypatch.setattr(retrieval.torch, "randperm", lambda count, **_: torch.arange(count))  # type: ignore[attr-defined]
    found = judged(golden, size)
    for name, row in (("pred", MODEL), ("gt", RECORDED)):
        tops = [value(found, f"top-{k}", row) for k in (1, 2, 3)]
        assert tops == pytest.approx(golden[f"rprec_{name}_B{size}"].tolist(), rel=1e-5)
        score = golden[f"match_{name}_B{size}"].item()
        assert value(found, "matching_score", row) == pytest.approx(score, rel=1e-5)
    assert [value(found, f"top-{k}", CHANCE) for k in (1, 2, 3)] == [k / size for k in (1, 2, 3)]
    # Motions that are all alike share all places, so none is among the first.
    assert value(found, "top-1", STILL) == 0 and value(found, "matching_score", STILL) > 0
    assert value(found, "fid") == pytest.approx(golden["fid_pred_gt_float64"].item(), rel=1e-5)
    rows = {one.row for one in found.figures if one.name == "evaluator.fid"}
    assert rows == {MODEL, TRAINING, STILL}, "recorded motion has no distance to itself"
