"""The DMD: padding, hidden tokens, windows without seams, seeds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from toy_gpt import PATTERN, STREAMS, random_codes

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.diffusion.dmd import Dmd, DmdConfig
from motionloom.models.diffusion.module import DmdModule, hidden_stretch
from motionloom.models.diffusion.sampling import blend_weights, decode_motions, window_starts
from motionloom.models.diffusion.schedule import Sampler, ScheduleConfig
from motionloom.models.gpt.tokens import Codes
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.models.tokenizer.single import MqConfig
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.store.networks import TrainedTokenizer

SMALL = DmdConfig(
    dim=16, ff=32, encoder_layers=1, decoder_layers=2, heads=4, dropout=0.0, attention_dropout=0.0
)


@pytest.fixture
def net() -> Dmd:
    torch.manual_seed(0)
    return Dmd(SMALL, STREAMS, PATTERN, 6).eval()


def test_padded_batch_equals_each_clip_alone(net: Dmd) -> None:
    net.double()
    codes, length = random_codes([5, 2, 1]), torch.tensor([19, 8, 3])
    noisy, step = torch.randn(3, 20, 6).double(), torch.tensor([3, 500, 999])
    noisy[torch.arange(20) >= length[:, None]] = 1e3
    together = net(noisy, step, codes.codes, length)
    for row, (frames, groups) in enumerate(zip(length.tolist(), [5, 2, 1], strict=True)):
        mine = {s.name: codes.codes[s.name][row : row + 1, : groups * s.per_group] for s in STREAMS}
        alone = net(noisy[row : row + 1, :frames], step[row : row + 1], mine, length[row : row + 1])
        torch.testing.assert_close(together[row, :frames], alone[0], rtol=1e-9, atol=1e-9)
        assert (together[row, frames:] == 0).all()


def test_hidden_tokens_say_nothing_and_others_do(net: Dmd) -> None:
    codes, length = random_codes([4, 4]), torch.tensor([16, 16])
    noisy, step = torch.randn(2, 16, 6), torch.tensor([100, 100])
    other = {**codes.codes, "hand": codes.codes["hand"].clone()}
    other["hand"][:, 2] = (other["hand"][:, 2] + 1) % 5
    hidden = torch.zeros(2, 4, dtype=torch.bool)
    hidden[0, 2] = True
    a, b = (net(noisy, step, c, length, hidden) for c in (codes.codes, other))
    assert torch.equal(a[0], b[0])
    assert not torch.allclose(a[1], b[1], atol=1e-4)
    # Nothing is missed where nothing is left out.
    plain = net(noisy, step, codes.codes, length)
    torch.testing.assert_close(plain[1], a[1])
    assert not torch.allclose(plain[0], a[0], atol=1e-4)


def test_stretches_hidden_in_training() -> None:
    """One stretch a row, within the row's groups and at most half of them, in the share asked for."""
    assert hidden_stretch(torch.tensor([4, 4]), 4, 0.0) is None
    torch.manual_seed(0)
    groups = torch.tensor([1, 2, 5, 16]).repeat(2000)
    hidden = hidden_stretch(groups, 16, 0.5)
    assert hidden is not None and hidden.shape == (8000, 16)
    count = hidden.sum(1)
    assert (count <= (groups // 2).clamp(min=1)).all()
    assert not (hidden & (torch.arange(16) >= groups[:, None])).any()
    assert (torch.nn.functional.pad(hidden.long(), (1, 1)).diff(dim=1).abs().sum(1) <= 2).all()
    # 8,000 fair draws: six deviations
    assert (count > 0).float().mean().item() == pytest.approx(0.5, abs=0.034)
    longest = count[groups == 16]
    assert set(longest.tolist()) == set(range(9))
    assert hidden[groups == 16].any(0).all()


def test_windows_cover_and_weights_add_up() -> None:
    assert window_starts(160, 160, 32) == window_starts(12, 160, 32) == [0]
    assert window_starts(164, 160, 32) == [0, 4]
    assert window_starts(400, 160, 32) == [0, 128, 240]
    for frames in (164, 288, 292, 1204):
        starts = window_starts(frames, 160, 32)
        weights = blend_weights(starts, 160, 32, frames)
        torch.testing.assert_close(weights.sum(0), torch.ones(frames, dtype=torch.float64))
        for row, start in enumerate(starts):
            assert (weights[row, :start] == 0).all()
            assert (weights[row, start + 160 :] == 0).all()
        assert weights.diff(dim=1).abs().max() <= 2 / 33  # no window comes or goes at once


@pytest.mark.parametrize("sampler", ["ddpm", "ddim", "dpm++"])
def test_a_motion_does_not_depend_on_its_batch(net: Dmd, sampler: Sampler) -> None:
    codes = random_codes([3, 12, 3, 9])
    how: dict[str, Any] = {"sampler": sampler, "steps": 4, "window": 16, "overlap": 8}
    together = decode_motions(net, codes, seeds=[4, 5, 6, 7], **how)
    for row, groups in enumerate(codes.groups.tolist()):
        mine = Codes({k: v[row : row + 1] for k, v in codes.codes.items()}, codes.groups[row : row + 1])
        alone = decode_motions(net, mine, seeds=[4 + row], **how)
        assert together[row].shape == (4 * groups, 6)
        torch.testing.assert_close(together[row], alone[0], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("sampler", ["ddpm", "ddim", "dpm++"])
def test_a_short_motion_is_as_without_windows(net: Dmd, sampler: Sampler) -> None:
    codes = random_codes([5, 3])
    wide = decode_motions(net, codes, seeds=[1, 2], sampler=sampler, steps=5)
    tight = decode_motions(net, codes, seeds=[1, 2], sampler=sampler, steps=5, window=20, overlap=8)
    for a, b in zip(wide, tight, strict=True):
        assert torch.equal(a, b)
    # by hand: one pass over the whole motion at each step
    scheduler = net.config.schedule.sampler(sampler, 5)
    generator = torch.Generator().manual_seed(1)
    x = torch.randn(20, 6, generator=generator)[None]
    extra = {} if sampler == "dpm++" else {"generator": [generator]}
    mine = {name: values[:1] for name, values in codes.codes.items()}
    with torch.no_grad():
        for step in scheduler.timesteps:
            x = scheduler.step(net(x, step[None], mine, torch.tensor([20])), step, x, **extra).prev_sample
    torch.testing.assert_close(wide[0], x[0], atol=1e-4, rtol=1e-4)


def test_mistakes_are_named(net: Dmd) -> None:
    codes = random_codes([4, 4])
    with pytest.raises(UserError, match="1 seeds"):
        decode_motions(net, codes, seeds=[1])
    with pytest.raises(UserError, match="overlap 16"):
        decode_motions(net, codes, seeds=[1, 2], window=16, overlap=16)
    with pytest.raises(UserError, match="2000 denoising steps"):
        decode_motions(net, codes, seeds=[1, 2], steps=2000)
    with pytest.raises(UserError, match="hidden"):
        decode_motions(net, codes, seeds=[1, 2], hidden=torch.zeros(2, 4, dtype=torch.bool))
    with pytest.raises(ValueError, match="noise has no velocity"):
        DmdConfig(velocity_weight=1.0)
    with pytest.raises(ValueError, match=r"12 frames.* 16"):
        net(torch.zeros(1, 16, 6), torch.tensor([1]), random_codes([3]).codes, torch.tensor([12]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("predicts", "steps", "sampler"), [("sample", 300, "dpm++"), ("epsilon", 1200, "ddpm")]
)
def test_tokens_that_belong_to_one_motion_become_that_motion(
    predicts: Any, steps: int, sampler: Sampler
) -> None:
    """Each of four, within 5 % of their spread; where it predicts noise 20 % in four times the steps."""
    torch.manual_seed(0)
    schedule = ScheduleConfig(betas="linear", predicts=predicts)
    net = Dmd(SMALL.model_copy(update={"dim": 64, "ff": 128, "schedule": schedule}), STREAMS, PATTERN, 6)
    codes, rows, length = random_codes([8] * 4), torch.arange(16) % 4, torch.full((16,), 32)
    waves = torch.sin(torch.linspace(0, 6, 32)[:, None] * torch.rand(4, 1, 6) * 3 + 6 * torch.rand(4, 1, 6))
    motion = waves / waves.std()
    mine = {name: values[rows] for name, values in codes.codes.items()}
    optimizer = torch.optim.AdamW(net.parameters(), lr=1e-3)
    for _ in range(steps):
        step, noise = torch.randint(0, 1000, (16,)), torch.randn(16, 32, 6)
        made = net(schedule.noiser().add_noise(motion[rows], noise, step), step, mine, length)
        loss = (made - (motion[rows] if predicts == "sample" else noise)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    drawn = torch.stack(decode_motions(net.eval(), codes, seeds=[1, 2, 3, 4], sampler=sampler, steps=100))
    apart = (drawn[:, None] - motion).square().mean((2, 3)).sqrt()
    assert torch.equal(apart.argmin(1), torch.arange(4))
    assert apart.diagonal().max() < (0.05 if predicts == "sample" else 0.2)


# The DMD learns in its tokenizer's coordinates, and what it makes comes back to the motion's own units.

LAYOUT = MotionLayout.named("wholebody363")
TINY = DmdConfig(dim=8, ff=8, encoder_layers=1, decoder_layers=1, heads=2, dropout=0.0, attention_dropout=0.0)


def stats() -> FeatureStats:
    rng = np.random.default_rng(0)
    mean, std = rng.normal(size=LAYOUT.dim), rng.uniform(0.5, 2.0, size=LAYOUT.dim)
    return FeatureStats(mean.astype(np.float32), std.astype(np.float32), 100, LAYOUT)


def tokenizer(finger_gain: float, root_gain: float) -> Tokenizer:
    torch.manual_seed(1)
    config = MqConfig.model_validate(
        {"part": "all", "width": 8, "code_dim": 6, "num_codes": 9, "quantizer": "ema", "depth": 0,
         "finger_gain": finger_gain, "root_gain": root_gain}
    )  # fmt: skip
    made = config.build(LAYOUT)
    made.basis.learn(stats().mean, stats().std)
    for book in made.codebooks().values():
        torch.nn.init.normal_(book.codebook)
        book.initialised.fill_(True)
        book._is_initialised = True
    return made.freeze()


@pytest.mark.parametrize(("finger_gain", "root_gain", "velocity"), [(4.0, 5.0, 0.0), (0.0, 1.0, 3.0)])
def test_the_loss_is_that_of_real_frames_and_columns_in_the_tokenizers_coordinates(
    finger_gain: float, root_gain: float, velocity: float
) -> None:
    """And of velocities between real frames, where the network predicts the motion itself."""
    frozen = tokenizer(finger_gain, root_gain)
    torch.manual_seed(0)
    schedule = ScheduleConfig(predicts="sample" if velocity else "epsilon")
    config = TINY.model_copy(update={"velocity_weight": velocity, "schedule": schedule})
    net = Dmd(config, frozen.streams, frozen.pattern, frozen.dim)
    module = DmdModule(net, OptimConfig(), seed=0, max_steps=2, tokenizer=frozen)
    motion, length = torch.randn(3, 16, frozen.dim), torch.tensor([16, 9, 12])
    present = torch.ones(3, frozen.dim, dtype=torch.bool)
    present[1, frozen.dim // 2 :] = False
    torch.manual_seed(5)
    found = module.losses({"motion": motion, "length": length, "present": present})["loss"]
    torch.manual_seed(5)
    step, noise = torch.randint(0, 1000, (3,)), torch.randn(3, 16, frozen.dim)
    whole = torch.tensor([16, 8, 12])
    seen = frozen.basis.encode(motion).masked_fill(~present[:, None], 0.0)
    assert torch.equal(seen, motion.masked_fill(~present[:, None], 0.0)) == (root_gain == 1.0)
    codes = frozen.encode(motion, whole, present)
    made = net(schedule.noiser().add_noise(seen, noise, step), step, codes, whole)
    error, total, count, moved, moves = made - (seen if velocity else noise), 0.0, 0, 0.0, 0
    for row, frames in enumerate(whole.tolist()):
        own = error[row, :frames, present[row]]
        total, count = total + own.square().sum(), count + own.numel()
        steps = own.diff(dim=0)
        moved, moves = moved + steps.square().sum(), moves + steps.numel()
    torch.testing.assert_close(found, total / count + velocity * moved / moves, rtol=1e-5, atol=0)


def test_tokens_of_motions_are_those_of_each_alone() -> None:
    frozen, given = tokenizer(4.0, 5.0), stats()
    trained = TrainedTokenizer(frozen, {"stats": given})
    motions = [torch.randn(frames, frozen.dim) for frames in (18, 8)]
    found = trained.encode([given.denormalize(m.numpy(), trained.columns) for m in motions])
    assert found.groups.tolist() == [4, 2]
    for row, (motion, groups) in enumerate(zip(motions, (4, 2), strict=True)):
        alone = frozen.encode(motion[None, : 4 * groups])["code"]
        assert torch.equal(found.codes["code"][row, :groups], alone[0])


@pytest.mark.parametrize(("finger_gain", "root_gain"), [(4.0, 5.0), (0.0, 1.0)])
def test_coordinates_come_back_as_the_features(finger_gain: float, root_gain: float) -> None:
    frozen, given = tokenizer(finger_gain, root_gain), stats()
    trained = TrainedTokenizer(frozen, {"stats": given})
    motion = torch.randn(8, frozen.dim)
    found = trained.of_coordinates(frozen.coordinates(motion[None])[0])
    # Fingers go through rotations and back in float32, at bones of a few units.
    np.testing.assert_allclose(found, given.denormalize(motion.numpy(), trained.columns), atol=2e-4)
