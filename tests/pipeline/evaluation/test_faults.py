"""Faults of motion: each does what it says, and the metric that is made for it notices it, and no other."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from motionloom.datasets.synth.dance_plan import DanceConditions, DanceConfig, beats_of
from motionloom.datasets.synth.generate import Clip, SynthConfig, make_clip
from motionloom.datasets.synth.measure import agrees
from motionloom.models.metrics.dance_beats import beat_align
from motionloom.models.metrics.physics import Physics, physics
from motionloom.models.metrics.reconstruction import mpjpe, pa_mpjpe
from motionloom.pipeline.evaluation.faults import FAULTS, Joints, swapped

FPS = 20.0


def clips(action: str, count: int = 8) -> list[Clip]:
    config = SynthConfig(clips=count, seed=11, fps=FPS, actions=[action], min_seconds=3.0, max_seconds=5.0)
    return [make_clip(k, config) for k in range(count)]


def changed(clip: Clip, fault: str) -> Joints:
    out = FAULTS[fault](clip.joints.copy(), FPS, np.random.default_rng(0))
    assert out.shape == clip.joints.shape and np.isfinite(out).all()
    return out


@pytest.fixture(scope="module")
def kicks() -> list[Clip]:
    return clips("kick")


def bodies(kicks: list[Clip], fault: str | None) -> Physics:
    found = [physics(clip.joints if fault is None else changed(clip, fault), FPS) for clip in kicks]
    return Physics(*np.mean(found, axis=0))


def test_physics_notices_what_is_made_for_it(kicks: list[Clip]) -> None:
    clean = bodies(kicks, None)
    assert bodies(kicks, "noise of 1 cm").jitter > 2 * clean.jitter
    assert bodies(kicks, "noise of 5 cm").jitter > 3 * bodies(kicks, "noise of 1 cm").jitter
    assert bodies(kicks, "gliding 0.6 m/s").skating > clean.skating + 0.3
    assert bodies(kicks, "5 cm above the floor").floating > clean.floating + 40
    assert bodies(kicks, "3 cm in the floor").penetration > clean.penetration + 20
    still = bodies(kicks, "frozen")
    assert still.jitter == 0 and still.skating == 0


def test_physics_does_not_notice_another_motion(kicks: list[Clip]) -> None:
    """A mirror image and the way back are as bodily as the motion itself."""
    clean = bodies(kicks, None)
    for fault in ("mirrored", "backwards"):
        found = bodies(kicks, fault)
        assert found.jitter == pytest.approx(clean.jitter, rel=1e-6)
        assert found.floating == pytest.approx(clean.floating, abs=1e-6)


def test_the_caption_notices_the_side(kicks: list[Clip]) -> None:
    def sides(motions: list[Joints]) -> float:
        return float(
            np.mean([agrees(c.truth, m, None, FPS)["side"] for c, m in zip(kicks, motions, strict=True)])
        )

    assert sides([c.joints for c in kicks]) == 1.0
    assert sides([changed(c, "mirrored") for c in kicks]) == 0.0
    assert sides([changed(c, "gliding 0.6 m/s") for c in kicks]) == 1.0


def test_errors_by_name(kicks: list[Clip]) -> None:
    """What aligns the root does not see where a figure is; 1 cm of noise is 1.6 cm of distance."""
    clip = kicks[0]
    real = torch.from_numpy(clip.joints)
    for fault in ("gliding 0.6 m/s", "5 cm above the floor"):
        assert mpjpe(torch.from_numpy(changed(clip, fault)), real).max() < 1e-9
    noisy = torch.from_numpy(changed(clip, "noise of 1 cm"))
    # The mean length of a normal deviate in three dimensions is 1.596 times its width.
    assert mpjpe(noisy, real, root=None).mean() == pytest.approx(15.96, rel=0.03)
    assert pa_mpjpe(noisy, real).mean() < mpjpe(noisy, real).mean()


def test_the_beat_notices_lateness() -> None:
    dances = DanceConfig(songs=6, song_seconds=12.0, conditions=DanceConditions(audio=1, both=0))
    config = SynthConfig(
        clips=6, seed=3, fps=FPS, actions=["dance"], min_seconds=6.0, max_seconds=8.0, dances=dances
    )
    found: dict[str, list[float]] = {"": [], "0.3 s late": [], "mirrored": []}
    for clip in (make_clip(k, config) for k in range(6)):
        beats = np.array(beats_of(clip.truth, len(clip.joints) / FPS))
        for fault in found:
            joints = changed(clip, fault) if fault else clip.joints
            found[fault].append(beat_align(joints[:, :22], beats[beats < len(joints) / FPS - 0.2], FPS))
    assert np.mean(found[""]) > np.mean(found["0.3 s late"]) + 0.2
    assert np.mean(found["mirrored"]) == pytest.approx(np.mean(found[""]), abs=1e-6)


@pytest.mark.parametrize("count", [2, 3, 50])
def test_nobody_keeps_the_own_motion(count: int) -> None:
    found = swapped(count, np.random.default_rng(1))
    assert sorted(found.tolist()) == list(range(count)) and (found != np.arange(count)).all()
