"""The evaluator's network and losses: lengths, contacts, gains, who is trained when, losses written out."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from motionloom.datasets.conditions import Condition
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.evaluator.losses import EvaluatorLossConfig, matching_loss, movement_loss
from motionloom.models.evaluator.module import EvaluatorModule
from motionloom.models.evaluator.network import Evaluator, EvaluatorConfig
from motionloom.models.training.optim import OptimConfig

LAYOUT = MotionLayout.named("h3d263")
TEXT = 6
SMALL = EvaluatorConfig(movement_hidden=12, movement=10, motion_hidden=8, text_hidden=7, latent=5)
LENGTH = torch.tensor([40, 37, 36, 12, 7, 4])


def network(**changes: Any) -> Evaluator:
    torch.manual_seed(0)
    return Evaluator(SMALL.model_copy(update=changes), LAYOUT, TEXT, 40).eval()


def batch(dtype: torch.dtype | None = None) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(0)
    motion = torch.randn(len(LENGTH), 40, LAYOUT.dim, generator=generator, dtype=torch.float64)
    words = torch.randn(len(LENGTH), 5, TEXT, generator=generator, dtype=torch.float64)
    mask = torch.arange(5)[None] < torch.tensor([5, 1, 3, 4, 2, 5])[:, None]
    dtype = dtype or torch.get_default_dtype()
    text = Condition(words.to(dtype), mask, None)
    return {"motion": motion.to(dtype), "length": LENGTH, "conditions": {"text": text}}


def module(net: Evaluator, **changes: Any) -> EvaluatorModule:
    given: dict[str, Any] = {"seed": 0, "max_steps": 8, "movement_optim": OptimConfig(), "movement_steps": 4}
    return EvaluatorModule(net, OptimConfig(), **given | changes)


@pytest.mark.usefixtures("float64")
def test_what_a_motion_is_batched_with_plays_no_part() -> None:
    """Alone, without its padding, and with rubbish behind its last unit."""
    net, given = network(), batch()
    together = net.encode_motion(given["motion"], LENGTH)
    for row, length in enumerate(LENGTH.tolist()):
        alone = net.encode_motion(given["motion"][row : row + 1, :length], LENGTH[row : row + 1])
        torch.testing.assert_close(alone[0], together[row], rtol=1e-9, atol=1e-12)
    other = given["motion"].clone()
    other[1, 36:] = 9.0  # 37 frames are nine units
    torch.testing.assert_close(net.encode_motion(other, LENGTH)[1], together[1], rtol=1e-9, atol=1e-12)
    other[1, 35] = 9.0
    assert (net.encode_motion(other, LENGTH)[1] - together[1]).abs().max() > 1e-4


@pytest.mark.usefixtures("float64")
def test_contacts_are_not_read_and_the_root_counts_five_times() -> None:
    net, plain, motion = network(), network(root_gain=1.0), batch()["motion"]
    plain.load_state_dict(net.state_dict())
    changed = motion.clone()
    changed[..., LAYOUT.slice("foot_contacts")] += 7
    torch.testing.assert_close(net.encode_motion(changed, LENGTH), net.encode_motion(motion, LENGTH))
    assert len(net.read_columns) == 259
    # The published way: deviations of the root a fifth of what they are.
    changed[..., :4] *= 5
    torch.testing.assert_close(plain.encode_motion(changed, LENGTH), net.encode_motion(motion, LENGTH))
    target, units = net.whole_units(motion, LENGTH)
    assert units.tolist() == [10, 9, 9, 3, 1, 1]
    torch.testing.assert_close(target[0, :40, -4:], 5 * motion[0, :, -4:])


def test_columns_that_a_clip_lacks_are_the_mean() -> None:
    layout = MotionLayout.named("wholebody363")
    net = Evaluator(SMALL, layout, TEXT, 40).eval()
    assert net.motion_dim == len(net.read_columns) == 313, "no contacts in this layout, and no face"
    present = torch.ones(2, 313, dtype=torch.bool)
    present[:, np.searchsorted(layout.part("bodyhand"), layout.part("hand"))] = False
    motion = torch.randn(2, 40, 313)
    length = torch.tensor([40, 21])
    without = torch.where(present[:, None], motion, 0.0)
    torch.testing.assert_close(net.encode_motion(motion, length, present), net.encode_motion(without, length))


def test_each_is_trained_in_its_time_and_by_its_own_loss() -> None:
    """No gradient of the pairs reaches the movement encoder, whose dropout is the autoencoder's alone."""
    net = network(dropout=0.5)
    trained, given = module(net), batch()
    trained.train()
    movement, pairs = trained.optimizer_groups()
    assert [s for s in range(8) if movement.steps_at(s)] == [0, 1, 2, 3]
    assert [s for s in range(8) if pairs.steps_at(s)] == [4, 5, 6, 7]
    every = {id(p) for p in net.parameters()} | {id(p) for p in trained.decoder.parameters()}
    assert {id(p) for group in (movement, pairs) for p in group.params()} == every
    for group, others in ((movement, pairs), (pairs, movement)):
        trained.zero_grad()
        trained.losses_of(group.name, given, {})["loss"].backward()
        assert all(p.grad is not None for p in group.params()), group.name
        assert all(p.grad is None for p in others.params()), group.name
    drawn = [
        {name: trained.losses_of(name, given, {})["loss"].item() for name in ("movement", "matching")}
        for _ in "ab"
    ]
    assert drawn[0]["movement"] != drawn[1]["movement"] and drawn[0]["matching"] == drawn[1]["matching"]


def test_the_margin_loss_is_the_published_one_over_all_its_rolls() -> None:
    text, motion = torch.randn(2, 5, 3, generator=torch.Generator().manual_seed(0)) * 4
    own = [math.dist(a, b) for a, b in zip(text.tolist(), motion.tolist(), strict=True)]
    rolled = []
    for shift in range(1, 5):
        moved = motion.roll(-shift, 0)
        away = [math.dist(a, b) for a, b in zip(text.tolist(), moved.tolist(), strict=True)]
        rolled.append(sum(max(0.0, 6.0 - d) ** 2 for d in away) / 5)
    found = matching_loss(text, motion, margin=6.0)
    assert 0 == min(rolled) < max(rolled), "pairs on both sides of the margin"
    assert found["loss"].item() == pytest.approx(sum(d * d for d in own) / 5 + sum(rolled) / 4, rel=1e-5)
    assert found["own"].item() == pytest.approx(sum(own) / 5, rel=1e-5)
    same = torch.zeros(4, 3, requires_grad=True)
    matching_loss(same, same * 1.0, margin=6.0)["loss"].backward()
    assert same.grad is not None and torch.isfinite(same.grad).all(), "equal latents have a gradient"


def test_the_autoencoders_loss_counts_real_frames_of_present_columns() -> None:
    generator = torch.Generator().manual_seed(0)
    pred, target = torch.randn(2, 3, 12, 4, generator=generator)
    units, count = torch.randn(3, 3, 2, generator=generator), torch.tensor([3, 1, 2])
    present = torch.tensor([[True] * 4, [True, True, False, False], [True] * 4])
    error: list[float] = []
    size: list[float] = []
    change: list[float] = []
    for row, number in enumerate(count.tolist()):
        error += [
            abs(float(pred[row, t, d] - target[row, t, d]))
            for t in range(4 * number)
            for d in range(4)
            if present[row, d]
        ]
        size += units[row, :number].abs().flatten().tolist()
        change += (units[row, 1:number] - units[row, : number - 1]).abs().flatten().tolist()
    config = EvaluatorLossConfig(sparsity=0.3, smoothness=0.7)
    found = movement_loss(pred, target, units, count, present, config=config)
    means = [sum(values) / len(values) for values in (error, size, change)]
    assert found["reconstruction"].item() == pytest.approx(means[0], rel=1e-5)
    assert found["loss"].item() == pytest.approx(means[0] + 0.3 * means[1] + 0.7 * means[2], rel=1e-5)


def test_wrong_widths_and_lengths_are_refused() -> None:
    net = network()
    motion: Tensor = torch.zeros(1, 40, 263)
    with pytest.raises(ValueError, match=r"263.* 262"):
        net.encode_motion(motion[..., 1:], torch.tensor([40]))
    with pytest.raises(ValueError, match=r"44 frames.* 40"):
        net.encode_motion(torch.zeros(1, 44, 263), torch.tensor([44]))
    with pytest.raises(ValueError, match=r"6 text features.* 7"):
        net.encode_text(torch.zeros(1, 2, 7), torch.ones(1, 2, dtype=torch.bool))
    with pytest.raises(ValueError, match="no multiple of 4"):
        Evaluator(SMALL, LAYOUT, TEXT, 42)
