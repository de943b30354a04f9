"""The DMD learns in its tokenizer's coordinates, and what it makes comes back to the motion's own units."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.diffusion.dmd import Dmd, DmdConfig
from motionloom.models.diffusion.module import DmdModule
from motionloom.models.diffusion.schedule import ScheduleConfig
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.models.tokenizer.single import MqConfig
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.store.networks import TrainedTokenizer

LAYOUT = MotionLayout.named("wholebody363")
SMALL = DmdConfig(
    dim=8, ff=8, encoder_layers=1, decoder_layers=1, heads=2, dropout=0.0, attention_dropout=0.0
)


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
    config = SMALL.model_copy(update={"velocity_weight": velocity, "schedule": schedule})
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
