"""The denoiser: schedules against public tables, masking, guidance, batched sampling."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from torch import Tensor

from motionloom.models.diffusion.network import TextDenoiser, TextDenoiserConfig
from motionloom.models.diffusion.sampling import sample_motions
from motionloom.models.diffusion.schedule import Sampler, ScheduleConfig
from motionloom.pipeline.baselines.mdm.network import Mdm
from motionloom.pipeline.editing.inbetween.network import InBetweenConfig, InBetweener

SMALL = TextDenoiserConfig(dim=32, ff=64, layers=2, heads=2, dropout=0.0)
OURS = InBetweenConfig(dim=32, ff=64, layers=2, heads=2, dropout=0.0)


def network(config: TextDenoiserConfig, motion_dim: int = 5, text_dim: int = 7) -> TextDenoiser:
    kind = InBetweener if isinstance(config, InBetweenConfig) else Mdm
    return kind(config, motion_dim, text_dim)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "config"),
    [("mdm_cosine", ScheduleConfig()), ("ude_linear", ScheduleConfig(betas="linear", predicts="epsilon"))],
)
def test_schedule_equals_public_tables(shared: Path, name: str, config: ScheduleConfig) -> None:
    golden = np.load(shared / "golden" / "t9_diffusion_A.npz", allow_pickle=False)
    noiser = config.noiser()
    np.testing.assert_allclose(noiser.betas, golden[f"{name}__betas"], rtol=2e-5, atol=1e-7)
    np.testing.assert_allclose(noiser.alphas_cumprod, golden[f"{name}__alphas_cumprod"], rtol=5e-4, atol=1e-7)
    x0, eps, t = (torch.from_numpy(golden[key]) for key in ("x0", "eps", "t"))
    np.testing.assert_allclose(noiser.add_noise(x0, eps, t), golden[f"{name}__x_t"], atol=2e-5)
    # The mean of one reverse step: diffusers adds noise, so its own noise is taken off again.
    noiser.set_timesteps(config.steps)
    for row, step in enumerate(t.tolist()):
        x_t = torch.from_numpy(golden[f"{name}__x_t"][row : row + 1])
        out = torch.from_numpy(golden["model_out"][row : row + 1])
        made = noiser.step(out, step, x_t, generator=torch.Generator().manual_seed(0))
        taken = made.prev_sample
        if config.predicts == "epsilon":
            wanted = golden[f"{name}__x0_from_eps"][row]
            np.testing.assert_allclose(made.pred_original_sample[0], wanted, rtol=1e-3, atol=2e-3)
        if step > 0:
            drawn = torch.randn(x_t.shape, generator=torch.Generator().manual_seed(0))
            taken = taken - golden[f"{name}__post_var"][row] ** 0.5 * drawn
        np.testing.assert_allclose(taken[0], golden[f"{name}__p_mean"][row], rtol=1e-3, atol=2e-3)


@pytest.mark.parametrize("shift", [1.0, 5.0])
def test_a_shift_is_noise_so_many_times_as_strong(shift: float) -> None:
    kept, shifted = (np.cumprod(1 - ScheduleConfig(shift=s).beta_table()) for s in (1.0, shift))
    noise = np.sqrt((1 - kept) / kept)[:-1]
    np.testing.assert_allclose(np.sqrt((1 - shifted) / shifted)[:-1], shift * noise, rtol=1e-9)
    assert (np.diff(shifted) < 0).all() and shifted[-1] >= 0


@pytest.mark.parametrize("sampler", ["ddpm", "ddim", "dpm++"])
def test_any_number_of_steps_begins_in_noise(sampler: Sampler) -> None:
    for total in (50, 1000):
        for steps in {*range(1, total, 1 + total // 40), total // 3, total // 2 + 1, total - 1, total}:
            taken = ScheduleConfig(steps=total).sampler(sampler, steps).timesteps.tolist()
            assert len(taken) == steps and taken[0] >= 0.9 * total - 1, (total, steps, taken[0])
            # The solver's own spacing may take a step twice where it takes all of them.
            twice = sampler == "dpm++" and steps == total
            assert all(0 <= later < sooner + twice for sooner, later in pairwise(taken)), (total, steps)


@pytest.mark.parametrize("steps", [1, 7, 40, 334, 501, 600, 1000])
@pytest.mark.parametrize("predicts", ["sample", "epsilon"])
def test_ddim_of_any_number_of_steps_equals_its_formula(
    steps: int, predicts: Literal["sample", "epsilon"]
) -> None:
    config = ScheduleConfig(betas="linear", predicts=predicts)
    kept = np.cumprod(1 - config.beta_table())
    taken = config.sampler("ddim", steps).timesteps.tolist()

    def motion(x: Tensor, at: int) -> Tensor:
        """Its mean, where motion has mean 2 and deviation 0.5."""
        signal, noise = kept[at], 1 - kept[at]
        return 2 + 0.25 * signal**0.5 / (0.25 * signal + noise) * (x - 2 * signal**0.5)

    def predict(x: Tensor, step: Tensor) -> Tensor:
        at = int(step)
        found = motion(x, at)
        return found if predicts == "sample" else (x - kept[at] ** 0.5 * found) / (1 - kept[at]) ** 0.5

    x = torch.randn(3, 4, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    drawn = config.denoise(predict, x.clone(), [], "ddim", steps)
    for at, following in zip(taken, [*taken[1:], -1], strict=True):
        found, next_kept = motion(x, at), kept[following] if following >= 0 else 1.0
        noise = (x - kept[at] ** 0.5 * found) / (1 - kept[at]) ** 0.5
        x = next_kept**0.5 * found + (1 - next_kept) ** 0.5 * noise
    assert torch.allclose(drawn, x, atol=2e-4)


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("config", [SMALL, OURS])
@pytest.mark.parametrize("frames", [7, 8])
def test_padding_plays_no_part(config: TextDenoiserConfig, frames: int) -> None:
    torch.manual_seed(0)
    net = network(config).eval()
    x, text = torch.randn(1, 12, 5), torch.randn(1, 7)
    step, conditioned = torch.tensor([30]), torch.tensor([True])
    mask = torch.arange(12)[None] < frames
    padded = net(x, step, text, mask, conditioned)
    alone = net(x[:, :frames], step, text, mask[:, :frames], conditioned)
    torch.testing.assert_close(padded[:, :frames], alone, atol=1e-5, rtol=1e-5)
    assert (padded[:, frames:] == 0).all()


def test_frames_of_a_token_lie_side_by_side() -> None:
    net = InBetweener(OURS, 3, 7)
    x = torch.arange(15.0).view(1, 5, 3)
    tokens = net.tokens(x)
    assert tokens.shape == (1, 3, 6) and tokens[0, 1].tolist() == [6, 7, 8, 9, 10, 11]
    assert tokens[0, 2].tolist() == [12, 13, 14, 0, 0, 0]


def test_the_condition_is_added_to_every_frame() -> None:
    torch.manual_seed(0)
    x, mask, step = torch.randn(1, 12, 5), torch.ones(1, 12, dtype=torch.bool), torch.tensor([30])
    for config, reached in ((SMALL, False), (OURS, True)):
        net = network(config.model_copy(update={"layers": 1})).eval()
        for values in net.stack.blocks.parameters():
            torch.nn.init.zeros_(values)  # blocks that pass on what they are given
        one, two = (net(x, step, torch.full((1, 7), t), mask, torch.tensor([True])) for t in (0.0, 1.0))
        assert bool((one != two).any(-1).all()) is reached


@pytest.mark.parametrize("config", [SMALL, OURS])
def test_hidden_text_has_no_influence(config: TextDenoiserConfig) -> None:
    torch.manual_seed(0)
    net = network(config).eval()
    x, mask, step = torch.randn(1, 12, 5), torch.ones(1, 12, dtype=torch.bool), torch.tensor([30])
    for conditioned, same in ((False, True), (True, False)):
        pair = [net(x, step, torch.randn(1, 7) * 3, mask, torch.tensor([conditioned])) for _ in range(2)]
        assert torch.allclose(*pair, atol=1e-6) is same


@pytest.mark.parametrize("sampler", ["ddpm", "ddim", "dpm++"])
def test_a_motion_does_not_depend_on_its_batch(sampler: Sampler) -> None:
    torch.manual_seed(0)
    net = Mdm(SMALL, 5, 7)
    text = torch.randn(3, 7)
    together = sample_motions(net, text, [8, 12, 8], seeds=[4, 5, 6], sampler=sampler, steps=5)
    for row, frames in enumerate([8, 12, 8]):
        alone = sample_motions(net, text[row : row + 1], [frames], seeds=[4 + row], sampler=sampler, steps=5)
        torch.testing.assert_close(together[row], alone[0], atol=1e-4, rtol=1e-4)
        assert together[row].shape == (frames, 5)


@pytest.mark.parametrize("guidance", [1.0, 3.0])
def test_guidance_goes_from_without_text_past_with_text(guidance: float) -> None:
    """A denoiser that answers 1 with text and 0 without: guided by s the answer is 0 + s * (1 - 0)."""
    net = Mdm(SMALL, 5, 7)
    net.forward = lambda x, step, text, mask, conditioned: (  # type: ignore[method-assign]
        torch.ones_like(x) * conditioned[:, None, None]
    )
    made = sample_motions(net, torch.zeros(1, 7), [8], seeds=[1], sampler="ddim", steps=4, guidance=guidance)
    torch.testing.assert_close(made[0], torch.full((8, 5), guidance), atol=1e-4, rtol=0.0)
