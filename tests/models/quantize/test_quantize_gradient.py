"""`GradientQuantizer`: golden UDE vectors, both terms' gradients, masks, starts, dead codes, learning."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from motionloom.models.quantize.gradient import GradientQuantizer, GradientQuantizerConfig

SMALL = GradientQuantizerConfig(num_codes=8, dim=4)


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def with_codebook(codebook: Tensor, **settings: float) -> GradientQuantizer:
    config = GradientQuantizerConfig(num_codes=len(codebook), dim=codebook.shape[1], **settings)
    quantizer = GradientQuantizer(config)
    with torch.no_grad():
        quantizer.codebook.copy_(codebook)
    return quantizer


@pytest.mark.parametrize("mode", ["training", "evaluation"])
def test_golden_ude(shared: Path, mode: str) -> None:
    with np.load(shared / "golden" / "t7_quantizer_A.npz", allow_pickle=False) as file:
        golden = {k: torch.from_numpy(np.atleast_1d(file[k])).squeeze() for k in file.files}
    quantizer = with_codebook(golden["codebook"]).train(mode == "training")
    out = quantizer(golden["x"].permute(0, 2, 1))
    assert torch.equal(out.codes.flatten(), golden["ude_codes"])
    torch.testing.assert_close(out.penalty.detach(), golden["ude_loss"], rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(out.metrics["perplexity"], golden["ude_perplexity"], rtol=1e-6, atol=1e-6)


def test_gradients_of_both_terms_are_those_of_the_formula() -> None:
    codebook, z = torch.randn(5, 3, dtype=torch.float64), torch.randn(2, 7, 3, dtype=torch.float64)
    weights = {"codebook_weight": 0.7, "commitment_weight": 0.3}
    quantizer = with_codebook(codebook, **weights).double()
    with torch.no_grad():
        quantizer.codebook.copy_(codebook)
    z.requires_grad_()
    downstream = torch.randn_like(z)
    out = quantizer(z)
    (out.penalty + (out.quantized * downstream).sum()).backward()
    codes = torch.cdist(z.detach().flatten(0, 1), codebook).argmin(1).view(2, 7)
    error = z.detach() - codebook[codes]
    assert torch.equal(out.codes, codes)
    assert z.grad is not None and quantizer.codebook.grad is not None
    torch.testing.assert_close(out.penalty.detach(), error.square().mean(), rtol=1e-12, atol=0)
    torch.testing.assert_close(z.grad, downstream + 0.3 * 2 * error / error.numel(), rtol=1e-12, atol=1e-14)
    expected = torch.zeros_like(codebook)
    expected.index_add_(0, codes.flatten(), -0.7 * 2 * error.flatten(0, 1) / error.numel())
    torch.testing.assert_close(quantizer.codebook.grad, expected, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(out.quantized.detach(), codebook[codes], rtol=1e-12, atol=1e-14)


def test_data_start_takes_rows_of_the_first_batch_once() -> None:
    quantizer = GradientQuantizer(SMALL.model_copy(update={"start": "data"}))
    z = torch.randn(3, 10, 4)
    out = quantizer(z)
    assert out.metrics["usage"] == 1
    before = quantizer.codebook.detach().clone()
    assert ((before[:, None] == z.reshape(-1, 4)).all(-1).sum(1) == 1).all()
    quantizer(torch.randn(3, 10, 4))
    again = GradientQuantizer(SMALL.model_copy(update={"start": "data"}))
    again.load_state_dict(quantizer.state_dict())
    again(torch.randn(3, 10, 4))
    assert torch.equal(quantizer.codebook, before)
    assert torch.equal(again.codebook, before)
