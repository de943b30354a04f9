"""`EmaQuantizer` and `ResidualQuantizer`: golden vectors, our reset semantics, float32 state, checkpoints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from motionloom.models.quantize.base import QuantizerConfig, draw_rows
from motionloom.models.quantize.ema import EmaQuantizer, ResidualQuantizer
from motionloom.models.training import distributed
from motionloom.models.training.stage_module import Batch, OptimConfig, StageModule


@pytest.fixture(scope="module")
def golden(shared: Path) -> dict[str, Tensor]:
    with np.load(shared / "golden" / "t7_quantizer_A.npz", allow_pickle=False) as file:
        return {k: torch.from_numpy(np.atleast_1d(file[k])).squeeze() for k in file.files}


def rows(x: Tensor) -> Tensor:
    """[N, C, T] of the public code -> [N, T, C]."""
    return x.permute(0, 2, 1)


def with_state(codebook: Tensor, count: float) -> EmaQuantizer:
    quantizer = EmaQuantizer(QuantizerConfig(num_codes=len(codebook), dim=codebook.shape[1]))
    state = quantizer.state_dict()
    state["codebook"], state["ema_sum"] = codebook.clone(), codebook * count
    state["ema_count"], state["initialised"] = torch.full((len(codebook),), count), torch.tensor(True)
    quantizer.load_state_dict(state)
    return quantizer


def close(a: Tensor, b: Tensor, atol: float = 1e-5) -> None:
    torch.testing.assert_close(a.detach(), b, rtol=1e-5, atol=atol)


def test_golden_eval_and_gradient(golden: dict[str, Tensor]) -> None:
    quantizer = with_state(golden["codebook"], 3.0).eval()
    z = rows(golden["x"]).clone().requires_grad_()
    out = quantizer(z)
    assert torch.equal(out.codes, golden["codes"])
    close(out.quantized, rows(golden["eval_quantized"]))
    close(out.penalty, golden["eval_commit_loss"])
    close(out.metrics["perplexity"], golden["eval_perplexity"])
    (0.5 * out.quantized.sum() + out.penalty).backward()
    assert z.grad is not None
    close(z.grad, rows(golden["grad_x"]))
    close(quantizer.codebook, golden["codebook"], 0)


def test_golden_training_updates(golden: dict[str, Tensor]) -> None:
    quantizer = with_state(golden["codebook"], 3.0)
    out = quantizer(rows(golden["x"]))
    close(out.quantized, rows(golden["train_quantized"]))
    close(out.penalty, golden["train_commit_loss"])
    close(out.metrics["perplexity"], golden["train_perplexity"])
    assert out.metrics["resets"] == 0
    close(quantizer.codebook, golden["codebook1"])
    close(quantizer.ema_sum, golden["code_sum1"])
    close(quantizer.ema_count, golden["code_count1"])
    quantizer(rows(golden["x2"]))
    close(quantizer.codebook, golden["codebook2"])


def test_golden_after_their_initialisation_and_outside_resets(golden: dict[str, Tensor]) -> None:
    """From the public code's first-K initialisation on: the same, except for what a reset code becomes."""
    quantizer = with_state(rows(golden["x"]).reshape(-1, 16)[:64], 1.0)
    quantizer(rows(golden["x"]))
    close(quantizer.codebook, golden["init_codebook_after"])
    close(quantizer.ema_count, golden["init_code_count_after"])
    # Counts sit at 0.99 + 0.01 n: a code used once must stay at exactly 1 and not be reset by rounding.
    out = quantizer(rows(golden["x2"]))
    reset = golden["reset_code_count_after2"] < 1
    assert out.metrics["resets"] == reset.sum() > 0
    close(quantizer.codebook[~reset], golden["reset_codebook_after2"][~reset])
    close(quantizer.ema_count[~reset], golden["reset_code_count_after2"][~reset])
    close(quantizer.ema_sum[~reset], golden["reset_code_sum_after2"][~reset])
    assert torch.equal(quantizer.ema_count[reset], torch.ones(int(reset.sum())))
    close(quantizer.ema_sum[reset], quantizer.codebook[reset])
    batch = rows(golden["x2"]).reshape(-1, 16)
    same = (quantizer.codebook[reset][:, None] == batch).all(-1)
    assert (same.sum(1) == 1).all()  # each is one row of the batch,
    assert same.sum(0).max() == 1  # and all of them different ones


def test_a_first_step_that_is_repeated_initialises_again() -> None:
    """As where no CUDA graph of it could be made: its buffers are put back, and what mirrors them."""
    quantizer = EmaQuantizer(QuantizerConfig(num_codes=16, dim=4))

    class Bare(StageModule):
        def losses(self, batch: Batch) -> dict[str, Tensor]:
            return {"loss": self.net(batch["z"]).penalty}

    module = Bare(quantizer, OptimConfig(), seed=0, max_steps=1)
    restore, z = module.saved_state(), torch.randn(4, 10, 4)
    first = quantizer(z).codes
    restore()
    assert not quantizer.initialised
    assert torch.equal(quantizer(z).codes, first) and quantizer.initialised


def test_means_of_fewer_values_than_ranks(monkeypatch: pytest.MonkeyPatch) -> None:
    """3 of 16 rows count, one of them on this one of 8 ranks: its share is 8 thirds of its value."""
    monkeypatch.setattr(distributed, "world_size", lambda: 8)
    monkeypatch.setattr(distributed, "sum_over_ranks", lambda _: torch.tensor(3.0))
    share = distributed.masked_mean(torch.tensor([1.5, 9.0]), torch.tensor([True, False]))
    assert float(share) == pytest.approx(1.5 * 8 / 3)


def test_first_batch_initialises_with_its_own_distinct_rows() -> None:
    quantizer = EmaQuantizer(QuantizerConfig(num_codes=16, dim=4))
    z = torch.randn(4, 10, 4)
    out = quantizer(z)
    assert bool(quantizer.initialised)
    assert out.metrics["usage"] == 1  # every code owns at least the row it was made of
    assert out.metrics["resets"] == 0
    other = EmaQuantizer(QuantizerConfig(num_codes=16, dim=4), salt=1)
    other(z)
    assert not torch.allclose(other.codebook, quantizer.codebook)


def test_unused_codes_are_reset_to_rows_of_the_batch_until_they_are_used() -> None:
    codebook = torch.cat([torch.zeros(1, 4), torch.full((7, 4), 100.0)])
    quantizer = with_state(codebook, 1.0)
    z = torch.randn(3, 20, 4)
    out = quantizer(z)
    assert out.metrics["resets"] == 7
    assert (quantizer.codebook[1:, None] == z.reshape(-1, 4)).all(-1).any(1).all()
    again = quantizer(z)
    assert again.metrics["resets"] == 0  # each now owns at least its own row and stays
    assert again.metrics["usage"] >= 7 / 8


def test_draws_are_distinct_valid_and_uniform() -> None:
    x = torch.arange(40.0)[:, None]
    mask = torch.arange(40) % 4 != 0
    seen = torch.zeros(40)
    for step in range(400):
        drawn = draw_rows(x, mask, 10, salt=0, step=torch.tensor(step))[:, 0].long()
        assert len(drawn.unique()) == 10
        seen[drawn] += 1
    assert seen[~mask].sum() == 0
    assert seen[mask].min() > 90  # expected 133, standard deviation 9.4
    assert seen[mask].max() < 180
    few = draw_rows(x[:3], None, 7, salt=0, step=torch.tensor(0))[:, 0].long()
    assert few.unique().tolist() == [0, 1, 2]
    assert few.bincount().max() == 3


def test_state_stays_float32_under_casts_and_autocast() -> None:
    torch.manual_seed(0)
    config = QuantizerConfig(num_codes=8, dim=16)
    cast, plain = EmaQuantizer(config), EmaQuantizer(config)
    cast.bfloat16()
    batches = [torch.randn(2, 40, 16).bfloat16() for _ in range(3)]
    for z in batches:
        plain(z.float())
        with torch.autocast("cpu", torch.bfloat16):
            out = cast(z)
        assert out.quantized.dtype == torch.bfloat16
        assert out.penalty.dtype == torch.float32
    for name, value in plain.state_dict().items():
        assert cast.state_dict()[name].dtype == value.dtype
        assert torch.equal(cast.state_dict()[name], value)
    assert cast.double().codebook.dtype == torch.float32


def test_golden_residual_levels(golden: dict[str, Tensor]) -> None:
    """As lucidrains has them, with a penalty on every level."""
    quantizer = ResidualQuantizer(QuantizerConfig(num_codes=64, dim=16), 4)
    for i in range(4):
        quantizer.level(i).codebook.copy_(golden["rvq_codebooks"][i])
    quantizer.freeze()
    quantizer.train()
    out = quantizer(rows(golden["x"]))
    assert torch.equal(out.codes, golden["rvq_indices"])
    close(out.quantized, golden["rvq_out"])
    close(quantizer.vectors(out.codes), golden["rvq_out"])
    for i in range(4):
        close(quantizer.level(i).vectors(out.codes[..., i]), golden["rvq_all_codes"][i])
    close(out.metrics["penalty"], golden["rvq_commit_loss"].flatten())
    close(out.penalty, golden["rvq_commit_loss"].sum())


def test_levels_do_not_start_from_the_same_rows() -> None:
    """Rows that made level 0 have a zero residual; were level 1 made of them, it would be all zero."""
    quantizer = ResidualQuantizer(QuantizerConfig(num_codes=16, dim=4), 2)
    quantizer(torch.randn(4, 50, 4))
    assert (quantizer.level(1).codebook.norm(dim=1) > 1e-3).float().mean() > 0.7
