"""The bone term of the tokenizers: it sees directions of bones, and nothing of where they are."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.schema import UserError
from motionloom.models.stage_module import OptimConfig
from motionloom.models.tokenizer.bones import Bones
from motionloom.models.tokenizer.build import build_tokenizer
from motionloom.models.tokenizer.config import H2VQConfig
from motionloom.models.tokenizer.losses import bone_loss
from motionloom.models.tokenizer.module import TokenizerModule
from motionloom.pipeline.evaluation import local_joints

LAYOUT = MotionLayout.named("wholebody363")
RNG = np.random.default_rng(0)
STD = RNG.uniform(0.1, 2.0, LAYOUT.dim).astype(np.float32)


def features(frames: int = 5) -> np.ndarray:
    return RNG.standard_normal((2, frames, LAYOUT.dim)).astype(np.float32)


@pytest.mark.parametrize(("part", "count"), [("bodyhand", 51), ("body", 21), ("all", 51)])
def test_bones_equal_those_of_the_joints(part: Part, count: int) -> None:
    columns = LAYOUT.part(part)
    x = features()
    found = Bones(LAYOUT, columns, STD)(torch.from_numpy(x[..., columns])).numpy()
    whole = MotionLayout.named("wholebody313")
    joints = local_joints((x * STD)[..., : whole.dim], whole)
    skeleton = LAYOUT.skeleton
    assert found.shape == (2, 5, count, 3)
    for bone in range(count):
        vector = joints[..., bone + 1, :] - joints[..., skeleton.parents[bone + 1], :]
        want = vector / np.linalg.norm(skeleton.offsets[bone + 1])
        np.testing.assert_allclose(found[..., bone, :], want, rtol=1e-5, atol=1e-4)


def test_moving_a_whole_arm_and_hand_costs_one_bone() -> None:
    columns = LAYOUT.part("bodyhand")
    bones, one = Bones(LAYOUT, columns, STD), torch.zeros(1, 4, len(columns))
    other = one.clone()
    first = LAYOUT.slice("positions").start
    moved = [20, *range(22, 37)]  # the left wrist and its fingers
    for joint in moved:
        column = first + 3 * (joint - 1)
        other[..., column] = 0.05 / float(STD[column])
    changed = bones(other).abs().sum(-1)[0, 0].nonzero()[:, 0].tolist()
    assert changed == [19], "only the forearm, which ends in joint 20"
    length = float(np.linalg.norm(LAYOUT.skeleton.offsets[20]))
    loss = bone_loss(other, one, None, "l2", bones)
    assert float(loss) == pytest.approx((0.05 / length) ** 2 / (51 * 3), rel=1e-4)


def test_hands_that_are_not_held_do_not_count() -> None:
    columns = LAYOUT.part("bodyhand")
    bones = Bones(LAYOUT, columns, STD)
    one, other = (torch.from_numpy(features()[..., columns]) for _ in range(2))
    held = torch.from_numpy(LAYOUT.held_columns[[0, 0]])[:, columns]
    assert bones.held(held).sum(1).tolist() == [21, 21]
    with_hands = bone_loss(one, other, torch.tensor([5, 3]), "smooth_l1", bones, held)
    body = LAYOUT.part("body")
    where = np.searchsorted(columns, body)
    alone = bone_loss(
        one[..., where], other[..., where], torch.tensor([5, 3]), "smooth_l1", Bones(LAYOUT, body, STD)
    )
    torch.testing.assert_close(with_hands, alone)


def test_the_module_adds_the_term_by_its_weight() -> None:
    sizes = {"width": 8, "depth": 1, "code_dim": 8, "num_codes": 8, "reset_below": 0.1}
    batch = {"motion": torch.randn(2, 8, 313), "length": torch.tensor([8, 5])}
    values = []
    for weight in (0.0, 0.25):
        torch.manual_seed(0)
        config = H2VQConfig.model_validate({**sizes, "bone_weight": weight})
        net = build_tokenizer(config, LAYOUT)
        module = TokenizerModule(net, OptimConfig(), seed=0, max_steps=1, std=STD, **config.loss_terms())
        assert not [name for name in module.state_dict() if "bones" in name], "nothing to save"
        values.append(module.losses(batch))
    assert "bones" not in values[0]
    torch.testing.assert_close(values[1]["loss"], values[0]["loss"] + 0.25 * values[1]["bones"])


def test_fingers_alone_have_no_bones() -> None:
    for part in ("hand", "face"):
        with pytest.raises(UserError, match="bone_weight"):
            Bones(LAYOUT, LAYOUT.part(part), STD)
