"""FACT: what it reads, its attention, its loss and its way on, against slow versions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.conditions import Condition
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.layers.transformer import Block
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.baselines.fact.module import FactModule
from motionloom.pipeline.baselines.fact.network import (
    Fact,
    FactConfig,
    FactStack,
    MotionColumns,
    music_width,
    read_music,
)

SMPL, BODY = MotionLayout.named("smpl75"), MotionLayout.named("body133")
SMALL: dict[str, Any] = {"dim": 16, "heads": 2, "ff": 16, "layers": 1, "motion_layers": 1, "music_layers": 1}
LENGTHS: dict[str, Any] = {"motion_frames": 6, "music_frames": 10, "predicted_frames": 3}


def small(music: int = 4, **more: Any) -> Fact:
    torch.manual_seed(0)
    return Fact(FactConfig(**{**SMALL, **LENGTHS, **more}), BODY, "body", music_dim=music)


def test_smpl_is_read_as_rotation_matrices_and_written_back() -> None:
    rng = np.random.default_rng(0)
    mean, std = rng.normal(size=75), rng.uniform(0.5, 2, 75)
    own = rng.normal(size=(2, 3, 75)) * 0.7
    columns = MotionColumns("matrices", SMPL, "all").double()
    columns.learn(torch.from_numpy(mean), torch.from_numpy(std))
    given = torch.from_numpy((own - mean) / std)
    read = columns.read(given)
    turns = Rotation.from_rotvec(own[..., 3:].reshape(-1, 3)).as_matrix().reshape(2, 3, 24 * 9)
    np.testing.assert_allclose(
        read, np.concatenate([np.zeros((2, 3, 6)), own[..., :3], turns], -1), atol=1e-12
    )
    assert read.shape[-1] == columns.dim == 225
    # What is no rotation becomes the nearest one: a matrix that is only longer stays as it was.
    longer = read.clone()
    longer[..., 9:] *= 1.7
    np.testing.assert_allclose(columns.write(longer), given, atol=1e-9)
    with pytest.raises(UserError, match=r"net\.columns"):
        MotionColumns("matrices", BODY, "body")


def test_the_35_columns_of_music() -> None:
    assert (music_width(438), music_width(9)) == (35, 9)
    features = torch.randn(2, 12, 438, dtype=torch.float64)
    read = read_music(features)
    onset = features[..., 52]
    top = torch.zeros_like(onset)
    for row in range(2):
        for frame in range(1, 11):
            value = onset[row, frame]
            top[row, frame] = value > 0 and value > onset[row, frame - 1] and value >= onset[row, frame + 1]
    slow = [onset[..., None], features[..., :20], features[..., 40:52], top[..., None], features[..., 53:54]]
    assert torch.equal(read, torch.cat(slow, -1)) and top.sum() > 2
    assert torch.equal(read_music(features[..., :9]), features[..., :9])


def test_attention_is_scaled_by_the_width_and_sees_everything() -> None:
    config = FactConfig(**SMALL, **LENGTHS)
    stack = FactStack(config, 1).double()
    [block] = stack.blocks
    assert isinstance(block, Block)
    x = torch.randn(2, 5, 16, dtype=torch.float64)
    y = block.norm_attention(x)
    query, key, value = (y @ part.T for part in block.attention.qkv.weight.chunk(3))
    found = torch.zeros_like(x)
    for row in range(2):
        for head in (slice(0, 8), slice(8, 16)):
            scores = query[row, :, head] @ key[row, :, head].T / math.sqrt(16)
            found[row, :, head] = scores.softmax(-1) @ value[row, :, head]
    z = x + block.attention.out(found)
    z = z + block.ff_out(torch.nn.functional.gelu(block.ff_in(block.norm_ff(z))))
    torch.testing.assert_close(stack(x), z)

    net = small()
    motion, music = torch.randn(1, 6, 133), torch.randn(1, 10, 4)
    first = net(motion, music)
    for tensor in (motion, music):
        tensor[0, -1] += 1  # the last frame matters to the first output: nothing is causal
        assert not torch.allclose(net(motion, music)[0, 0], first[0, 0])


def batch(rows: int = 4) -> dict[str, Any]:
    heard = torch.ones(rows, 12, dtype=torch.bool)
    heard[1] = False
    return {
        "motion": torch.randn(rows, 12, 133),
        "length": torch.tensor([12, 12, 8, 9])[:rows],
        "conditions": {"audio": Condition(torch.randn(rows, 12, 4), heard)},
    }


def test_the_loss_against_loops() -> None:
    net, given = small(), batch()
    module = FactModule(net, OptimConfig(), seed=0, max_steps=1).eval()
    total, still, count = 0.0, 0.0, 0
    for row in (0, 3):  # with music, and nine frames or more
        motion, music = given["motion"][row : row + 1], given["conditions"]["audio"].features[row : row + 1]
        made = net(motion[:, :6], music[:, :10])
        for frame in range(3):
            total += float(((made[0, frame] - motion[0, 6 + frame]) ** 2).sum())
            still += float(((motion[0, 5] - motion[0, 6 + frame]) ** 2).sum())
            count += 133
    losses = module.losses(given)
    assert float(losses["loss"]) == pytest.approx(total / count, rel=1e-5)
    assert float(losses["still"]) == pytest.approx(still / count, rel=1e-5)


def test_it_goes_on_frame_by_frame_each_row_for_itself() -> None:
    net = small().eval()
    begun, music = torch.randn(2, 6, 133), torch.randn(2, 8, 4)
    made = net.go_on(begun, music, 11)
    assert made.shape == (2, 11, 133) and torch.equal(made[:, :6], begun)
    for row in range(2):
        motion, heard = begun[row : row + 1], torch.cat([music[row : row + 1], torch.zeros(1, 13, 4)], 1)
        for at in range(5):
            following = net(motion[:, -6:], heard[:, at : at + 10])[:, :1]
            motion = torch.cat([motion, following], 1)
        torch.testing.assert_close(made[row], motion[0], rtol=1e-4, atol=1e-5)
    assert torch.equal(net.go_on(begun, music, 4), begun[:, :4])


def test_more_predictions_than_motion_are_refused() -> None:
    with pytest.raises(ValueError, match="predicted_frames 7"):
        FactConfig(**SMALL, motion_frames=6, predicted_frames=7)
