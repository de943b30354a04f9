"""MotionCLIP: its coordinates, and its losses by a slow version."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from motionloom.datasets.conditions import Condition
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.layers.transformer import length_mask
from motionloom.models.training.stage_module import OptimConfig
from motionloom.pipeline.baselines.motionclip.module import MotionClipLossConfig, MotionClipModule
from motionloom.pipeline.baselines.motionclip.network import MotionClip, MotionClipConfig, SixD

SMALL = {"latent": 16, "ff": 32, "layers": 1, "heads": 2, "dropout": 0.0, "attention_dropout": 0.0}
LENGTH = torch.tensor([12, 7])
SMPL = MotionLayout.named("smpl75")


def smpl_motion(sixd: SixD, rows: int = 2) -> Tensor:
    """Normalised smpl75 motion [rows, 12, 75], and statistics for it."""
    rng = np.random.default_rng(0)
    mean, std = rng.normal(size=75) * 0.1, rng.uniform(0.1, 0.5, 75)
    sixd.learn(mean, std)
    return torch.from_numpy(rng.normal(size=(rows, 12, 75)))


@pytest.mark.usefixtures("float64")
def test_six_numbers_a_rotation() -> None:
    sixd = SixD(SMPL)
    motion = smpl_motion(sixd)
    seen = sixd.encode(motion)
    own = (motion * sixd.std + sixd.mean).numpy()
    turns = Rotation.from_rotvec(own[..., 3:].reshape(-1, 3)).as_matrix().reshape(2, 12, 24, 3, 3)
    np.testing.assert_allclose(seen[..., :144].reshape(2, 12, 24, 2, 3)[..., 0, :], turns[..., 0], atol=1e-9)
    np.testing.assert_allclose(seen[..., 144:147], own[..., :3], atol=1e-12)
    torch.testing.assert_close(sixd.decode(seen), motion)
    np.testing.assert_allclose(sixd.joints(seen), joints_of(own, SMPL), atol=1e-9)


@pytest.mark.usefixtures("float64")
@torch.no_grad()
def test_padding_and_what_a_clip_does_not_hold_change_nothing() -> None:
    net = MotionClip(MotionClipConfig(**SMALL), 6).eval()
    motion, mask = torch.randn(2, 12, 6), length_mask(LENGTH, 12)
    z = net.encode(net.coordinates(motion), mask)
    made = net.decode(z, mask)
    for row, count in enumerate(LENGTH.tolist()):
        alone = length_mask(LENGTH[row : row + 1], count)
        torch.testing.assert_close(net.encode(motion[row : row + 1, :count], alone)[0], z[row])
        torch.testing.assert_close(net.decode(z[row : row + 1], alone)[0], made[row, :count])
        assert (made[row, count:] == 0).all()
    torch.testing.assert_close(net.decode(z * 7.0, mask), made)
    present = torch.tensor([[True] * 4 + [False] * 2, [True] * 6])
    assert (net.coordinates(motion, present)[0, :, 4:] == 0).all()


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("name", ["body133", "wholebody313", "smpl75"])
def test_losses_by_a_slow_version(name: str) -> None:
    layout, rng = MotionLayout.named(name), np.random.default_rng(0)
    sixd = SixD(layout) if name == "smpl75" else None
    if sixd is not None:
        motion = smpl_motion(sixd)
        mean, std = sixd.mean.numpy(), sixd.std.numpy()
    else:
        mean, std = rng.normal(size=layout.dim), rng.uniform(0.01, 0.1, layout.dim)
        motion = torch.from_numpy(rng.normal(size=(2, 12, layout.dim)))
    net = MotionClip(MotionClipConfig(**SMALL), layout.dim, sixd)
    weights = MotionClipLossConfig(features=2.0, joints=3.0, velocities=5.0, text=7.0)
    module = MotionClipModule(
        net, OptimConfig(), seed=0, max_steps=1, layout=layout, mean=mean, std=std, loss=weights
    ).eval()
    present, text = torch.from_numpy(layout.present_columns[[0, 3]]), torch.randn(2, 16)
    words = Condition(torch.zeros(2, 1, 16), torch.ones(2, 1).bool(), text)
    found = module.losses(
        {"motion": motion, "length": LENGTH, "present": present, "conditions": {"text": words}}
    )

    mask = length_mask(LENGTH, 12)
    seen = net.coordinates(motion, present)
    z = net.encode(seen, mask)
    made = net.decode(z, mask).detach()
    parts: dict[str, list[float]] = {"features": [], "joints": [], "velocities": [], "text": []}
    for row, count in enumerate(LENGTH.tolist()):
        own, true = (motions[row, :count].numpy() for motions in (made, seen))
        held = layout.present_columns[[0, 3][row]] if sixd is None else np.ones(150, bool)
        error = (own - true)[:, held]
        parts["features"] += (error**2).ravel().tolist()
        parts["velocities"] += (np.diff(error, axis=0) ** 2).ravel().tolist()
        if sixd is None:
            poses = [joints_of(motions * std + mean, layout) for motions in (own, true)]
        else:
            poses = [sixd.joints(torch.from_numpy(motions)).numpy() for motions in (own, true)]
        number = 22 if row == 0 else layout.num_joints
        parts["joints"] += ((poses[0] - poses[1])[:, :number] ** 2).ravel().tolist()
        cosine = z[row].double() @ text[row] / z[row].double().norm() / text[row].norm()
        parts["text"].append(1 - cosine.item())
    wanted = {key: float(np.mean(values)) for key, values in parts.items()}
    for key, value in wanted.items():
        assert found[key].item() == pytest.approx(value, rel=2e-5), key
    total = sum(weight * wanted[key] for key, weight in weights.dump().items() if isinstance(weight, float))
    assert found["loss"].item() == pytest.approx(total, rel=2e-5)
    found["loss"].backward()
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in net.parameters())
