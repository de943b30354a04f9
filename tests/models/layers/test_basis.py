"""The coordinates of the tokenizers: fingers as bones, the root louder, and back again."""

from __future__ import annotations

import numpy as np
import pytest
import roma
import torch

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.models.layers.basis import Basis
from motionloom.models.tokenizer.body_hand import H2VQConfig
from motionloom.models.tokenizer.module import TokenizerModule
from motionloom.models.training.stage_module import OptimConfig
from motionloom.pipeline.evaluation.reference_baselines import local_joints

LAYOUT = MotionLayout.named("wholebody363")
RNG = np.random.default_rng(0)
STD = RNG.uniform(0.1, 2.0, LAYOUT.dim).astype(np.float32)
MEAN = RNG.standard_normal(LAYOUT.dim).astype(np.float32)
WHOLE = MotionLayout.named("wholebody313")


def basis_of(part: Part = "bodyhand", root_gain: float = 5.0, finger_gain: float = 2.0) -> Basis:
    columns = LAYOUT.part(part)
    basis = Basis(LAYOUT, columns, root_gain=root_gain, finger_gain=finger_gain)
    basis.learn(MEAN[columns], STD[columns])
    return basis


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("part", ["bodyhand", "all"])
def test_out_is_the_inverse_of_in_and_zero_is_the_mean(part: Part) -> None:
    basis = basis_of(part)
    x = torch.from_numpy(RNG.standard_normal((2, 7, len(LAYOUT.part(part)))))
    torch.testing.assert_close(basis.decode(basis.encode(x)), x, rtol=0, atol=1e-9)
    torch.testing.assert_close(basis.encode(basis.decode(x)), x, rtol=0, atol=1e-9)
    x = torch.zeros(1, 4, x.shape[-1])  # the mean
    torch.testing.assert_close(basis.encode(x), x, rtol=0, atol=1e-9)
    torch.testing.assert_close(basis.decode(x), x, rtol=0, atol=1e-9)


def at(joint: int, field: str = "positions") -> slice:
    """Columns of a joint; the root has no position."""
    first = WHOLE.slice(field).start + 3 * (joint - (field == "positions"))
    return slice(first, first + 3)


def test_fingers_are_bones_and_the_rest_stays() -> None:
    columns, basis = LAYOUT.part("bodyhand"), basis_of()
    x = RNG.standard_normal((2, 5, len(columns))).astype(np.float32)
    seen = basis.encode(torch.from_numpy(x)).numpy()
    zero = basis._bent(torch.zeros(len(columns))).reshape(30, 3).numpy()
    real = x * STD[columns] + MEAN[columns]
    joints = local_joints(real, WHOLE)
    velocities = (real - MEAN[columns])[..., WHOLE.slice("velocities")].reshape(2, 5, 52, 3)
    speeds = STD[columns][WHOLE.slice("velocities")].reshape(52, 3)
    for joint in range(22, 52):
        parent = LAYOUT.skeleton.parents[joint]
        bone = joints[..., joint, :] - joints[..., parent, :]
        read = seen[..., at(joint)] * np.linalg.norm(LAYOUT.skeleton.offsets[joint]) / 2 + zero[joint - 22]
        if parent < 22:
            np.testing.assert_allclose(read, bone, rtol=1e-4, atol=1e-3)
        else:
            lengths = [np.linalg.norm(value, axis=-1) for value in (read, bone)]
            np.testing.assert_allclose(*lengths, rtol=1e-4, atol=1e-3)
        want = (velocities[..., joint, :] - velocities[..., parent, :]) / speeds[joint]
        np.testing.assert_allclose(seen[..., at(joint, "velocities")], want, rtol=1e-4, atol=1e-3)
    body = np.searchsorted(columns, LAYOUT.part("body"))
    np.testing.assert_allclose(seen[..., body[:4]], 5 * x[..., body[:4]])
    np.testing.assert_array_equal(seen[..., body[4:]], x[..., body[4:]])


def test_turning_a_wrist_leaves_the_shape_of_its_hand() -> None:
    basis, columns = basis_of(), LAYOUT.part("bodyhand")
    skeleton, turn = LAYOUT.skeleton, roma.random_rotmat(6).numpy()
    features = np.tile(RNG.standard_normal(len(columns)), (6, 1))
    rest = skeleton.rest_joints + 0.01 * RNG.standard_normal((52, 3))
    for joint in range(37, 52):  # the right hand, about its wrist
        features[:, at(joint)] = rest[21] + turn @ (rest[joint] - rest[21])
    features[:, at(21)] = rest[21]
    x = torch.from_numpy((features - MEAN[columns]) / STD[columns]).float()
    seen = basis.encode(x).numpy()
    for joint in range(37, 52):
        spread = np.abs(seen[..., at(joint)] - seen[:1, at(joint)]).max()
        assert (spread < 1e-3) if skeleton.parents[joint] != 21 else (spread > 0.1)


def test_without_gains_nothing_changes_and_nothing_is_saved() -> None:
    basis, x = basis_of(root_gain=1.0, finger_gain=0.0), torch.randn(1, 4, 313)
    assert torch.equal(basis.encode(x), x) and torch.equal(basis.decode(x), x) and not basis.state_dict()


SIZES = {"width": 8, "depth": 1, "code_dim": 8, "num_codes": 8, "reset_below": 0.1}


def test_the_loss_is_of_what_is_seen() -> None:
    torch.manual_seed(0)
    config = H2VQConfig.model_validate({**SIZES, "root_gain": 3.0, "finger_gain": 2.0})
    net = config.build(LAYOUT)
    net.basis.learn(MEAN[LAYOUT.part("bodyhand")], STD[LAYOUT.part("bodyhand")])
    module = TokenizerModule(net, OptimConfig(), seed=0, max_steps=1).eval()
    x = torch.randn(2, 8, 313)
    present = torch.from_numpy(LAYOUT.present_columns[[3, 0]])[:, LAYOUT.part("bodyhand")]
    batch = {"motion": x, "length": torch.tensor([8, 8]), "present": present}
    values = module.losses(batch)
    error = (
        net.basis.encode(net.features(net(x, present=present).reconstruction)) - net.basis.encode(x)
    ).square()
    want = error[present[:, None].expand_as(error)].mean()
    torch.testing.assert_close(values["recon"], want)
    garbage = {**batch, "motion": torch.where(present[:, None], x, 7.0)}
    torch.testing.assert_close(module.losses(garbage), values, rtol=0, atol=0)


@pytest.mark.parametrize("part", ["body", "hand", "face"])
def test_fingers_alone_are_refused(part: Part) -> None:
    with pytest.raises(UserError, match="finger_gain"):
        basis_of(part)


def test_autocast_leaves_the_coordinates_in_float32() -> None:
    basis = basis_of()
    x = torch.randn(2, 8, 313, generator=torch.Generator().manual_seed(0))
    seen = basis.encode(x)
    back = basis.decode(seen)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(basis.encode(x), seen)
        assert torch.equal(basis.decode(seen), back)
        assert basis.decode(seen.bfloat16()).dtype == torch.float32
