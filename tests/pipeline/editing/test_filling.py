"""Filling in: places with gradients, what a network is shown, what is kept, and what constraints do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.conditions import Condition
from motionloom.datasets.motion.features.codec import decode
from motionloom.datasets.motion.layout import LOWER, PIECES, MotionLayout
from motionloom.models.training.stage_module import OptimConfig
from motionloom.pipeline.editing.inbetween.filling import Filling, KnownMotion
from motionloom.pipeline.editing.inbetween.module import InBetweenModule
from motionloom.pipeline.editing.inbetween.network import InBetweenConfig, InBetweener
from motionloom.pipeline.editing.inbetween.observed import Observations, Places, Recovery, known_columns

LAYOUT = MotionLayout.named("body133")
COLUMNS = LAYOUT.part("all")
FRAMES = 24
TINY = InBetweenConfig(dim=16, ff=16, layers=1, heads=2, dropout=0.0, frames_per_token=1)


def statistics(layout: MotionLayout = LAYOUT) -> tuple[Any, Any]:
    mean, std = np.random.default_rng(0).normal(size=(2, layout.dim)).astype(np.float32) * 0.05
    return mean, np.abs(std) + np.float32(0.02)


def recovery(layout: MotionLayout = LAYOUT) -> Recovery:
    return Recovery(layout, layout.part("all"), *statistics(layout))


@pytest.mark.parametrize("name", ["body133", "tomato623"])
def test_the_roots_way_is_the_decoders_and_the_anchor_is_the_origin(name: str) -> None:
    layout = MotionLayout.named(name)
    found, motion = recovery(layout), torch.randn(2, 12, layout.dim)
    start = torch.tensor([0, 0])
    _, place = found.way(motion, start)
    root = decode((motion * found.std + found.mean).numpy(), layout)[:, :, 0]
    np.testing.assert_allclose(place, root[..., [2, 0]], atol=1e-5)
    # Seen from another frame: that frame at the origin, as far from the others.
    turned, other = found.way(motion, torch.tensor([5, 7]))
    assert not other[0, 5].any() and not other[1, 7].any() and not turned[1, 7].any()
    torch.testing.assert_close((other[:, 1:] - other[:, :-1]).norm(dim=-1), place.diff(dim=1).norm(dim=-1))


def test_columns_without_the_root_are_refused() -> None:
    with pytest.raises(UserError, match="wholebody363"):
        layout = MotionLayout.named("wholebody363")
        Recovery(layout, layout.part("face"), *statistics(layout))


def test_a_step_is_known_where_both_its_frames_and_the_root_are() -> None:
    pieces = torch.zeros(1, 6, len(PIECES), dtype=torch.bool)
    pieces[0, 1:4, PIECES.index("left_arm")] = True
    pieces[0, 2:4, LOWER] = True
    known = known_columns(pieces, LAYOUT, COLUMNS)[0]
    wrist = LAYOUT.skeleton.index("left_wrist")
    position = LAYOUT.slice("positions").start + 3 * (wrist - 1)
    velocity = LAYOUT.slice("velocities").start + 3 * wrist
    assert known[:, position].tolist() == [False, True, True, True, False, False]
    assert known[:, velocity].tolist() == [False, False, True, False, False, False]
    assert known[:, LAYOUT.slice("root_xz_velocity")].all(1).tolist() == [False, False, True] + [False] * 3
    assert known[:, LAYOUT.slice("root_height")].all(1).tolist() == [False, False, True, True, False, False]


def test_what_is_shown_is_the_truth() -> None:
    torch.manual_seed(0)
    motion, length = torch.randn(64, FRAMES, len(COLUMNS)), torch.full((64,), FRAMES)
    length[::2] = 15
    own = recovery()
    seen = Observations(LAYOUT, COLUMNS, *statistics(), 0.75)(motion, length)
    dim = len(COLUMNS)
    known = seen[..., dim : 2 * dim].bool()
    assert torch.equal(seen[..., :dim], motion * known)
    assert not known[::2, 15:].any()
    share = known.any(2).any(1).float().mean()
    assert 0.4 < share < 0.95  # of three quarters some are shown places alone
    places, stood, turned = seen[..., 2 * dim : 2 * dim + 4], seen[..., -2], seen[..., -1]
    first = stood.argmax(1)
    heading, place = own.way(motion, first)
    torch.testing.assert_close(places[..., :2], place * stood[..., None])
    torch.testing.assert_close(places[..., 2], heading.cos() * turned)
    assert (stood.sum(1) >= turned.sum(1)).all() and (turned.sum(1) < stood.sum(1)).any()


def test_the_loss_is_of_motions_and_their_steps_under_what_is_observed() -> None:
    torch.manual_seed(0)
    net, own = InBetweener(TINY, len(COLUMNS), 4), Observations(LAYOUT, COLUMNS, *statistics(), 1.0)
    module = InBetweenModule(net, OptimConfig(), seed=0, max_steps=1, observations=own).eval()
    motion, length, text = torch.randn(2, FRAMES, len(COLUMNS)), torch.tensor([FRAMES, 9]), torch.randn(2, 4)
    said = Condition(torch.zeros(2, 1, 4), torch.ones(2, 1, dtype=torch.bool), text)
    torch.manual_seed(1)
    found = module.losses({"motion": motion, "length": length, "conditions": {"text": said}})["loss"]
    torch.manual_seed(1)
    step, noise = torch.randint(0, 1000, (2,)), torch.randn_like(motion)
    shown, mask = torch.rand(2) >= 0, torch.arange(FRAMES) < length[:, None]
    made = net(module.noiser.add_noise(motion, noise, step), step, text, mask, shown, own(motion, length))
    errors = [(made - motion)[row, :n] for row, n in enumerate(length.tolist())]
    each = [one.square().mean() + TINY.velocity_weight * one.diff(dim=0).square().mean() for one in errors]
    torch.testing.assert_close(found, torch.stack(each).mean())


def filled(net: InBetweener, given: KnownMotion, text: torch.Tensor | None = None, window: int = 200) -> Any:
    filling = Filling(net, given, text, recovery(), window=window, overlap=window // 4)
    return filling([0, 1], "ddpm", 6)


def task() -> KnownMotion:
    """A motion whose begin and end are kept, the end half a metre further than it goes."""
    torch.manual_seed(1)
    motion = torch.randn(FRAMES, len(COLUMNS)) * 0.3
    pieces = torch.ones(1, FRAMES, len(PIECES), dtype=torch.bool)
    pieces[:, 8:16] = False
    known = known_columns(pieces, LAYOUT, COLUMNS)[0]
    anchor = torch.tensor([0])
    heading, place = recovery().way(motion[None], anchor)
    rooted = pieces[..., LOWER]
    places = Places(anchor, heading, place + 0.5 * (torch.arange(FRAMES) >= 16)[:, None], rooted, rooted)
    return KnownMotion(motion, known, places)


def test_known_values_are_kept_and_errors_fall(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    net, given = InBetweener(TINY, len(COLUMNS), 4), task()

    def missed() -> float:
        made = filled(net, given)
        assert torch.equal(made[:, given.mask], given.motion[given.mask].expand(2, -1))
        anchor = given.places.anchor.expand(2)
        landing = recovery().way(made, anchor)[1][:, -1] - given.places.place[:, -1]
        return float(landing.norm(dim=-1).mean())

    pulled = missed()
    monkeypatch.setattr(Filling, "_gradient_step", lambda self, motion: motion)
    assert pulled < 0.7 * missed()


class Aside(InBetweener):
    """Makes what is given, all of it off by as much as it says."""

    wanted: torch.Tensor
    off = 1.0

    def forward(self, noisy: torch.Tensor, *more: object, **named: object) -> torch.Tensor:
        return self.wanted.expand_as(noisy) + self.off


def test_what_the_network_misses_of_the_kept_part_is_led_off() -> None:
    net, given = Aside(TINY, len(COLUMNS), 4), task()
    nowhere = given.places._replace(
        heading_known=torch.zeros(1, FRAMES, dtype=torch.bool),
        place_known=torch.zeros(1, FRAMES, dtype=torch.bool),
    )
    still = KnownMotion(torch.zeros_like(given.motion), given.mask, nowhere)
    net.wanted = still.motion
    led = given.mask[0] & ~given.mask[8]
    off = filled(net, still)[0][8:16, led].mean(1)
    assert off[0] < 0.2 and off[-1] < 0.2  # half a smoothed jump would be left otherwise


def test_gaps_are_bridged_rather_by_straight_lines_the_more_the_network_misses() -> None:
    net, given = Aside(TINY, len(COLUMNS), 4), task()
    nowhere = torch.zeros(1, FRAMES, dtype=torch.bool)
    places = given.places._replace(heading_known=nowhere, place_known=nowhere)
    net.wanted = (torch.arange(FRAMES) * 0.3).sin()[:, None].expand_as(given.motion)
    carried = given.mask[0] & ~given.mask[8] & ~recovery().legs & torch.from_numpy(~recovery().steps)
    line = torch.lerp(net.wanted[7], net.wanted[16], torch.linspace(0, 1, 10)[1:-1, None])[:, carried]
    shares = []
    for net.off in (0.0, 1.0, 5.0):
        made = filled(net, KnownMotion(net.wanted, given.mask, places))[0][8:16, carried]
        shares.append(float((made - line).norm() / (net.wanted[8:16, carried] - line).norm()))
        # It leaves and arrives as the known frames lead, by .3 a frame at most, however far off it was made.
        assert (made[[0, -1]] - net.wanted[[7, 16]][:, carried]).abs().max() < 0.5
    # Smoothing alone bends the line towards how the known frames lead on.
    assert shares[0] > 0.9 and 0.6 > shares[1] > shares[2]


def test_windows_share_frames_and_a_caption_counts() -> None:
    """Overlapping windows keep what is known, and each of them hears the caption."""
    torch.manual_seed(0)
    net, given = InBetweener(TINY, len(COLUMNS), 4), task()
    net.text.weight.data *= 20
    one, other = (filled(net, given, text, window=10) for text in (torch.ones(4), -torch.ones(4)))
    assert torch.equal(one[:, given.mask], given.motion[given.mask].expand(2, -1))
    assert (one - other)[:, 8:16].abs().amax(2).min() > 0
