"""MDM: the network beside one made of torch's own parts, and its loss."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn

from motionloom.datasets.conditions import Condition
from motionloom.models.diffusion.module import TextDenoiserModule
from motionloom.models.diffusion.network import TextDenoiserConfig
from motionloom.models.diffusion.schedule import ScheduleConfig
from motionloom.models.training.stage_module import OptimConfig
from motionloom.pipeline.baselines.mdm.network import Mdm
from motionloom.pipeline.baselines.mdm.stage import published_names

SMALL = TextDenoiserConfig(dim=16, ff=24, layers=2, heads=4)


def published(net: Mdm) -> dict[str, Tensor]:
    """The network's tensors under MDM's names."""
    return {there: net.state_dict()[here] for here, there in published_names(net).items()}


def slow(weights: dict[str, Tensor], x: Tensor, step: int, text: Tensor) -> Tensor:
    """MDM's `trans_enc` for one motion [T, D] in evaluation, from its published tensors."""
    dim = weights["embed_text.bias"].shape[0]

    def linear(name: str, value: Tensor) -> Tensor:
        return value @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]

    def place(t: int) -> Tensor:
        angles = [t / 10_000 ** (2 * k / dim) for k in range(dim // 2)]
        return torch.tensor([f(a) for a in angles for f in (math.sin, math.cos)]).to(x)

    first = nn.functional.silu(linear("embed_timestep.time_embed.0", place(step)))
    token = linear("embed_timestep.time_embed.2", first) + linear("embed_text", text)
    rows = torch.cat([token[None], linear("input_process.poseEmbedding", x)])
    rows = rows + torch.stack([place(k) for k in range(len(rows))])
    layer = nn.TransformerEncoderLayer(dim, 4, 24, activation="gelu", batch_first=True)
    encoder = nn.TransformerEncoder(layer, 2, enable_nested_tensor=False).to(x).eval()
    stem = "seqTransEncoder."
    encoder.load_state_dict({n.removeprefix(stem): v for n, v in weights.items() if n.startswith(stem)})
    return linear("output_process.poseFinal", encoder(rows[None])[0, 1:])


@pytest.mark.usefixtures("float64")
def test_equals_one_of_torchs_parts() -> None:
    torch.manual_seed(0)
    net = Mdm(SMALL, 5, 7).double().eval()
    for parameter in net.parameters():
        nn.init.normal_(parameter, std=0.3)
    x, text, step = torch.randn(2, 9, 5), torch.randn(2, 7), torch.tensor([0, 731])
    mask = torch.arange(9) < torch.tensor([[9], [6]])
    found = net(x, step, text, mask, torch.tensor([True, False]))
    for row, frames, said in ((0, 9, text[0]), (1, 6, torch.zeros(7))):
        wanted = slow(published(net), x[row, :frames], int(step[row]), said)
        torch.testing.assert_close(found[row, :frames], wanted, atol=1e-5, rtol=1e-5)  # waves are float32


def test_the_loss_beside_a_slow_one() -> None:
    net = Mdm(SMALL, 5, 7)
    module = TextDenoiserModule(net, OptimConfig(), seed=0, max_steps=1).eval()
    torch.manual_seed(3)
    motion, length, text = torch.randn(3, 8, 5), torch.tensor([8, 3, 5]), torch.randn(3, 7)
    condition = Condition(text[:, None], torch.ones(3, 1, dtype=torch.bool), text)
    batch = {"motion": motion, "length": length, "conditions": {"text": condition}}
    torch.manual_seed(4)
    found = module.losses(batch)["loss"]
    torch.manual_seed(4)
    step, noise = torch.randint(0, 1000, (3,)), torch.randn(3, 8, 5)
    kept = torch.from_numpy(1 - ScheduleConfig().beta_table()).cumprod(0)
    total = 0.0
    for row, n in enumerate(length.tolist()):
        share = float(kept[step[row]])
        noisy = share**0.5 * motion[row, :n] + (1 - share) ** 0.5 * noise[row, :n]
        guess = net(
            noisy[None], step[row : row + 1], text[row : row + 1], torch.ones(1, n) > 0, torch.ones(1) > 0
        )
        total += float((guess[0] - motion[row, :n]).square().mean().detach()) / 3
    assert float(found.detach()) == pytest.approx(total, rel=1e-5)
