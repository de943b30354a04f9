"""`ResidualQuantizer`: golden lucidrains vectors, a penalty on every level, masks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from motionloom.models.quantize.ema import QuantizerConfig
from motionloom.models.quantize.residual import ResidualQuantizer


def test_golden(shared: Path) -> None:
    with np.load(shared / "golden" / "t7_quantizer_A.npz", allow_pickle=False) as file:
        golden = {k: torch.from_numpy(file[k]) for k in file.files if k == "x" or k.startswith("rvq")}
    quantizer = ResidualQuantizer(QuantizerConfig(num_codes=64, dim=16), 4)
    for i in range(4):
        quantizer.level(i).codebook.copy_(golden["rvq_codebooks"][i])
    quantizer.freeze()
    quantizer.train()
    z = golden["x"].permute(0, 2, 1)
    out = quantizer(z)
    assert torch.equal(out.codes, golden["rvq_indices"])
    torch.testing.assert_close(out.quantized, golden["rvq_out"], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(quantizer.vectors(out.codes), golden["rvq_out"], rtol=1e-5, atol=1e-5)
    for i in range(4):
        torch.testing.assert_close(
            quantizer.level(i).vectors(out.codes[..., i]), golden["rvq_all_codes"][i], rtol=1e-5, atol=1e-5
        )
    torch.testing.assert_close(
        out.metrics["penalty"], golden["rvq_commit_loss"].flatten(), rtol=1e-5, atol=1e-5
    )
    torch.testing.assert_close(out.penalty, golden["rvq_commit_loss"].sum(), rtol=1e-5, atol=1e-5)


def test_every_level_pulls_on_z_and_shrinks_the_residual() -> None:
    torch.manual_seed(0)
    quantizer = ResidualQuantizer(QuantizerConfig(num_codes=16, dim=4), 3)
    for _ in range(100):
        quantizer(torch.randn(4, 32, 4))
    z = torch.randn(4, 32, 4, requires_grad=True)
    out = quantizer.eval()(z)
    out.penalty.backward()
    total = torch.zeros_like(z)
    expected = torch.zeros_like(z)
    penalties = []
    for i in range(3):
        total = total + quantizer.level(i).vectors(out.codes[..., i])
        expected += 2 * (z.detach() - total) / z.numel()
        penalties.append((z.detach() - total).square().mean())
    assert z.grad is not None
    torch.testing.assert_close(z.grad, expected, rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(out.metrics["penalty"], torch.stack(penalties))
    assert penalties[0] > 1.5 * penalties[1] > 2 * penalties[2]


def test_levels_do_not_start_from_the_same_rows() -> None:
    """Rows that made level 0 have a zero residual; were level 1 made of them, it would be all zero."""
    quantizer = ResidualQuantizer(QuantizerConfig(num_codes=16, dim=4), 2)
    quantizer(torch.randn(4, 50, 4))
    assert (quantizer.level(1).codebook.norm(dim=1) > 1e-3).float().mean() > 0.7


def test_masked_batch_equals_truncated_batch() -> None:
    config = QuantizerConfig(num_codes=6, dim=4)
    padded, plain = ResidualQuantizer(config, 2), ResidualQuantizer(config, 2)
    for _ in range(3):
        z = torch.randn(1, 12, 4)
        mask = torch.arange(17)[None] < 12
        a, b = padded(torch.nn.functional.pad(z, (0, 0, 0, 5), value=7.0), mask), plain(z)
        assert a.codes.shape == (1, 17, 2)
        assert torch.equal(a.codes[:, :12], b.codes)
        torch.testing.assert_close(a.penalty, b.penalty)
    for name, value in plain.state_dict().items():
        torch.testing.assert_close(padded.state_dict()[name], value)
