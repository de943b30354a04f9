"""MDM: the network beside one made of torch's own parts, its loss, and schedules in float64."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from motionloom.datasets.conditions import Condition
from motionloom.models.diffusion.module import TextDenoiserModule
from motionloom.models.diffusion.network import TextDenoiserConfig
from motionloom.models.diffusion.schedule import ScheduleConfig
from motionloom.models.layers.transformer import waves
from motionloom.models.training.distributed import mean_of_rows
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


def test_hidden_texts_leave_the_projections_bias() -> None:
    net = Mdm(SMALL, 5, 7).eval()
    given = torch.randn(1, 9, 5), torch.tensor([30]), torch.zeros(1, 7), torch.ones(1, 9, dtype=torch.bool)
    shown, hidden = (net(*given, torch.tensor([seen])) for seen in (True, False))
    assert torch.equal(shown, hidden), "no text is the text of zeros"


def test_dropout_reaches_positions_and_the_inside_of_blocks() -> None:
    """With nearly all of it dropped, nothing of the input is left."""
    net = Mdm(SMALL.model_copy(update={"dropout": 0.999}), 5, 7).train()
    assert [m.p for m in net.modules() if isinstance(m, nn.Dropout)] == [0.999] * 3
    seen = []
    for block in net.stack.blocks:
        block.ff_out.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    net(
        torch.randn(2, 9, 5), torch.tensor([1, 2]), torch.randn(2, 7), torch.ones(2, 9) > 0, torch.ones(2) > 0
    )
    assert all((inner == 0).float().mean() > 0.98 for inner in seen)


def test_each_clip_counts_alike() -> None:
    """MDM's masked loss, clip by clip; a clip without the columns counts for nothing."""
    torch.manual_seed(0)
    error, length = torch.rand(4, 6, 3), [6, 2, 4, 5]
    mask = torch.arange(6) < torch.tensor(length)[:, None]
    present = torch.tensor([[True] * 3, [True, False, True], [True] * 3, [False] * 3])
    each = [error[row, :n][:, present[row]].mean() for row, n in enumerate(length)]
    torch.testing.assert_close(mean_of_rows(error, mask), torch.stack(
        [error[row, :n].mean() for row, n in enumerate(length)]).mean())  # fmt: skip
    torch.testing.assert_close(mean_of_rows(error, mask, present), torch.stack(each[:3]).mean())


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


COSINE, LINEAR = ScheduleConfig(), ScheduleConfig(betas="linear", predicts="epsilon")
SCALED = ScheduleConfig(betas="scaled_linear", predicts="epsilon", steps_offset=1, set_alpha_to_one=False)
TABLE: list[tuple[ScheduleConfig, int, tuple[float, ...]]] = [
    (COSINE, 0, (4.128422482e-05, 0.9999587158, 0, 1, 0)),
    (COSINE, 1, (4.614175274e-05, 0.9999125759, 2.178949615e-05, 0.5277814093, 0.4722185904)),
    (COSINE, 500, (0.003155691442, 0.4922851724, 0.003146005125, 0.0043678669, 0.9953562795)),
    (COSINE, 998, (0.7499993929, 2.428766907e-06, 0.7499939282, 0.00233767619, 0.4999969639)),
    (COSINE, 999, (0.999, 2.428766907e-09, 0.9989975761, 0.001556891715, 0.03162269987)),
    (ScheduleConfig(steps=50), 1, (0.003688954727, 0.9945699782, 0.001187195668, 0.6787689312, 0.3212302608)),
    (ScheduleConfig(steps=50), 25, (0.06304977735, 0.462706862, 0.05939597339, 0.08246448934, 0.9118674347)),
    (ScheduleConfig(steps=10), 5, (0.3098834401, 0.3408096398, 0.2379426322, 0.3303560248, 0.6378743186)),
    (LINEAR, 1, (0.0001199199199, 0.9997800921, 5.453187661e-05, 0.5452914995, 0.454708499)),
    (LINEAR, 500, (0.01005995996, 0.07779665837, 0.01005133578, 0.003058057076, 0.9941043508)),
    (LINEAR, 999, (0.02, 4.035829765e-05, 0.01999998353, 0.0001283514872, 0.9899486783)),
    (SCALED, 0, (0.00085, 0.99915)),
    (SCALED, 500, (0.004814954142, 0.2763326838)),
    (SCALED, 981, (0.01168475549, 0.005775500139)),
]  # fmt: skip


@pytest.mark.parametrize(("config", "t", "wanted"), TABLE)
def test_schedules_to_nine_places(config: ScheduleConfig, t: int, wanted: tuple[float, ...]) -> None:
    """Of the sampler that takes every step: what it holds, and what a step makes of x0, x_t and noise."""
    made: Any = config.sampler("ddpm", config.steps)
    found = [float(made.betas[t]), float(made.alphas_cumprod[t])]
    if len(wanted) > 2:
        epsilon = config.predicts == "epsilon"
        kept = made.alphas_cumprod[t]

        def mean(x0: float, x: float) -> float:
            """The step's outcome without its noise: a generator's draw is the same for both."""
            x0_, x_ = torch.tensor([[x0]]).double(), torch.tensor([[x]]).double()
            said = (x_ - kept.sqrt() * x0_) / (1 - kept).sqrt() if epsilon else x0_
            return float(made.step(said, t, x_, generator=torch.Generator().manual_seed(0)).prev_sample)

        drawn, nothing = torch.Generator().manual_seed(0), mean(0, 0)
        noise = float(torch.randn(1, 1, generator=drawn, dtype=torch.float64))
        found += [(nothing / noise) ** 2, mean(1, 0) - nothing, mean(0, 1) - nothing]
    assert found == pytest.approx(wanted, abs=1e-9, rel=2e-9)


def test_mld_takes_its_steps() -> None:
    made: Any = SCALED.sampler("ddim", 50)
    assert made.timesteps.tolist() == list(range(981, 0, -20))
    assert float(made.final_alpha_cumprod) == pytest.approx(0.99915, abs=1e-12)
    assert float(LINEAR.sampler("ddim", 50).final_alpha_cumprod) == 1  # type: ignore[attr-defined]


def test_time_steps_are_embedded_as_mdm_does() -> None:
    found = waves(torch.tensor([37]), 512)[0, :4]
    wanted = torch.tensor([-0.64353813, 0.76541405, -0.9065176, -0.42216802])
    torch.testing.assert_close(found, wanted, atol=5e-6, rtol=0)  # float32 angles
