"""The learning rate over the steps of a training."""

from __future__ import annotations

import pytest

from motionloom.models.training.optim import OptimConfig


def test_drops_multiply_from_their_steps_on() -> None:
    """T2M-GPT's schedule: a warm-up, then 0.05 times the rate from a step on."""
    config = OptimConfig(warmup_steps=4, drop_at=(10, 20), drop_factor=0.05)
    found = [config.factor(step, 100) for step in (0, 3, 9, 10, 19, 20, 99)]
    assert found == pytest.approx([0.25, 1, 1, 0.05, 0.05, 0.0025, 0.0025])
    assert config.factor(10, 100) == config.factor(10, 10_000), "a longer training begins the same"


def test_drops_and_cosine_multiply() -> None:
    plain, dropped = OptimConfig(schedule="cosine"), OptimConfig(schedule="cosine", drop_at=(50,))
    assert dropped.factor(49, 100) == plain.factor(49, 100)
    assert dropped.factor(50, 100) == pytest.approx(0.1 * plain.factor(50, 100))
