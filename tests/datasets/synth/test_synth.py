"""The synthetic source: captions are true, bodies move like bodies, clips follow from their index alone."""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import pytest

from motionloom.datasets.actions.measure import action_of, agrees
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.synth.actions.truth import ACTIONS, BASIC, SEATED, Span, draw
from motionloom.datasets.synth.generate import (
    Clip,
    SynthConfig,
    animate,
    make_clip,
    make_sample,
    split_of,
    synthesize,
    truth_of,
)

FPS = 30.0
CONFIG = SynthConfig(seed=2024, actions="all")
CLIPS = 280


@pytest.fixture(scope="module")
def clips() -> list[Clip]:
    return [make_clip(index, CONFIG) for index in (*range(CLIPS), 2001)]  # 2001 sits down and then waves


@pytest.fixture(scope="module")
def verdicts(clips: list[Clip]) -> list[dict[str, bool]]:
    return [agrees(clip.truth, clip.joints, clip.face, FPS) for clip in clips]


def actions_of(clip: Clip) -> list[str]:
    return [part["action"] for part in clip.truth.get("parts", [clip.truth])]


def test_captions_are_true(clips: list[Clip], verdicts: list[dict[str, bool]]) -> None:
    right: dict[tuple[str, str], list[bool]] = defaultdict(list)
    for clip, verdict in zip(clips, verdicts, strict=True):
        for attribute, ok in verdict.items():
            right[clip.truth["action"], attribute].append(ok)
            right["all", attribute].append(ok)
        right["all", "everything"].append(all(verdict.values()))
        right[clip.truth["action"], "everything"].append(all(verdict.values()))
    assert {action for action, _ in right} == {*ACTIONS, "all"}
    rates = {key: float(np.mean(values)) for key, values in right.items()}
    wrong = {key: rate for key, rate in rates.items() if rate < (0.99 if key[0] == "all" else 0.92)}
    assert not wrong


def test_people_stand_as_they_like_and_captions_stay_true() -> None:
    config = SynthConfig(seed=3, actions="all", poses="everyday", fps=20)
    made = [make_clip(index, config) for index in range(200)]
    verdicts = [agrees(clip.truth, clip.joints, clip.face, 20.0) for clip in made]
    assert np.mean([all(verdict.values()) for verdict in verdicts]) >= 0.99
    for clip in made:
        assert 2 <= len(clip.joints) / 20 <= config.max_seconds
        speed = 20 * np.linalg.norm(np.diff(clip.joints[:, :22], axis=0), axis=-1).max(1)
        assert max(speed[:10].max(), speed[-10:].max()) > 0.25, "stands still at both ends"
        assert clip.joints[:, [10, 11], 1].min() > -0.02, "a foot below the floor"
    few = [make_clip(index, CONFIG) for index in range(200)]
    spread, alike = (
        np.std([one.joints[0, 20] - one.joints[0, 16] for one in ones], 0) for ones in (made, few)
    )
    assert (spread > 1.3 * alike)[[0, 2]].all()  # aside and ahead of the shoulder


def test_a_person_has_a_pace_that_leaves_gravity_alone() -> None:
    for action in ("bow", "jump"):
        truth = draw(action, np.random.default_rng(1))
        slow, quick = (
            np.abs(
                np.diff(
                    animate(truth, Span(2.0, 2.0), FPS, np.random.default_rng(1), pace).solve()[:, 15], axis=0
                )
            )
            for pace in (0.9, 1.1)
        )
        assert (quick.max() > 1.05 * slow.max()) == (action == "bow")
        assert np.array_equal(quick, slow) == (action == "jump")


@pytest.mark.parametrize("layout", ["body133", "wholebody313"])
def test_captions_are_true_in_other_layouts(layout: str) -> None:
    config = SynthConfig(seed=5, layout=layout)
    fps = config.motion_layout.fps
    made = [make_clip(index, config) for index in range(84)]
    verdicts = [agrees(clip.truth, clip.joints, None, fps) for clip in made]
    assert np.mean([all(verdict.values()) for verdict in verdicts]) >= 0.97
    for clip in made:
        assert clip.joints.shape[1:] == (config.motion_layout.num_joints, 3)
        assert not clip.face_texts and "face" not in clip.truth
        assert ("left_hand" in clip.truth) == (layout == "wholebody313")


def test_a_foot_that_dips_under_the_floor_changes_no_verdict(
    clips: list[Clip], verdicts: list[dict[str, bool]]
) -> None:
    for number, (clip, verdict) in enumerate(zip(clips[:120], verdicts[:120], strict=True)):
        joints = clip.joints.copy()
        joints[: len(joints) // 5, [7 + number % 2, 10 + number % 2], 1] -= 0.04
        if clip.truth["action"] != "then":
            assert agrees(clip.truth, joints, clip.face, FPS) == verdict


def test_lies_are_found_out(clips: list[Clip]) -> None:
    swap = {"left": "right", "right": "left", "forward": "backward", "backward": "forward", "up": "forward"}
    swap |= {"clockwise": "counterclockwise", "counterclockwise": "clockwise", "down": "up", "both": "left"}
    faces = {"happy": "sad", "sad": "happy", "angry": "neutral", "surprised": "angry", "neutral": "happy"}
    lies = believed = 0
    for clip in clips:
        for attribute in ("direction", "side", "count", "left_hand", "face", "bpm", "action"):
            value = clip.truth.get(attribute)
            if value is None:
                continue
            lie: object
            if attribute in ("count", "bpm"):
                lie = value + (1 if attribute == "count" else 15)
            elif attribute == "action":
                lie = "crawl" if value != "crawl" else "jump"
            elif attribute == "face":
                lie = faces[value]
            elif attribute == "left_hand":
                lie = "fist" if value != "fist" else "spread"
            else:
                lie = swap[value]
            lies += 1
            believed += agrees({**clip.truth, attribute: lie}, clip.joints, clip.face, FPS)[attribute]
    assert lies > 800
    assert believed == 0


def test_directions_sides_and_counts_by_plain_geometry(clips: list[Clip]) -> None:
    """Seen from above, X points right and Z down the page; clockwise means turning to one's right."""
    seen = Counter[str]()
    for clip in clips:
        action, direction, side, count = (clip.truth[key] for key in ("action", "direction", "side", "count"))
        root, wrists, balls = clip.joints[:, 0], clip.joints[:, 20:22], clip.joints[:, 10:12]
        mine = 0 if side == "left" else 1
        seen[f"{action} {direction}" if action in ("walk", "run", "reach") else action] += 1
        if direction in ("clockwise", "counterclockwise"):
            # The person starts off towards +Z; their left is +X, and the circle lies on the side of the turn.
            middle = 0.5 * (root[:, 0].max() + root[:, 0].min())
            assert (middle > 0) == (direction == "counterclockwise")
            path = np.linalg.norm(np.diff(root[:, [0, 2]], axis=0), axis=-1).sum()
            assert np.linalg.norm(root[-1] - root[0]) < 0.45 * path
        elif action in ("walk", "run"):
            assert (root[-1, 2] - root[0, 2] > 0) == (direction != "backward")
        elif action == "turn" and clip.truth["style"] != "around":
            hips = clip.joints[-1, 1] - clip.joints[-1, 2]
            assert (-hips[2] > 0) == (direction == "left")
        elif action in ("jump", "hop"):
            air = (balls[:, :, 1].min(1) > 0.04).astype(int)
            assert (np.diff(air) > 0).sum() == count
        elif action == "kick":
            assert balls[:, mine, 1].max() > balls[:, 1 - mine, 1].max() + 0.3
        elif action == "punch":
            assert wrists[:, mine, 2].max() > wrists[:, 1 - mine, 2].max() + 0.15
        elif action in ("reach", "point") and direction == "down":
            low = int(np.argmin(wrists[:, mine, 1]))
            assert wrists[low, mine, 1] < 0.4 < wrists[low, 1 - mine, 1] - 0.3
        elif action in ("reach", "point") and direction == "up":
            assert wrists[:, mine, 1].max() > wrists[:, 1 - mine, 1].max() + 0.5
        elif actions_of(clip)[0] == "sit" and action == "then":
            seen["seated"] += actions_of(clip)[1] in SEATED
            assert (root[-1, 1] < 0.7) == (actions_of(clip)[1] in SEATED)
    assert len(seen) == 30 and seen["seated"]


def test_feet_stay_where_they_stand(clips: list[Clip]) -> None:
    slides = []
    for clip in clips:
        balls = clip.joints[:, (10, 11)]
        still = (balls[1:, :, 1] < 0.004) & (balls[:-1, :, 1] < 0.004)
        speed = np.linalg.norm(np.diff(balls[..., [0, 2]], axis=0), axis=-1) * FPS
        if clip.truth["action"] != "dance":
            slides.append(speed[still])
    slide = np.concatenate(slides)
    assert slide.mean() < 0.03
    assert np.percentile(slide, 95) < 0.1


def test_only_runs_and_jumps_leave_the_floor(clips: list[Clip]) -> None:
    for clip in clips:
        lowest = clip.joints[..., 1].min(axis=1)
        assert lowest.min() == pytest.approx(0.0, abs=1e-9)
        if any(action in ("jump", "run", "hop") for action in actions_of(clip)):
            both_up = clip.joints[:, (10, 11), 1].min(axis=1) > 0.02
            assert both_up.mean() > 0.03, clip.texts[0]
        else:
            # Joints have some flesh between them and a floor that somebody lies or crawls on.
            assert lowest.max() < (0.12 if clip.truth["action"] in ("lie", "crawl") else 0.03), clip.texts[0]


def test_joints_bend_the_right_way(clips: list[Clip]) -> None:
    for clip in clips:
        x = clip.joints
        for side in (0, 1):
            hip, knee, ankle = (x[:, j + side] for j in (1, 4, 7))
            thigh, shin = knee - hip, ankle - knee
            # The hinge of a knee that bends forward points to the person's left, as the hip line does.
            bend, left = np.cross(thigh, shin), x[:, 1] - x[:, 2]
            sine = (
                np.linalg.norm(bend, axis=-1) / np.linalg.norm(thigh, axis=-1) / np.linalg.norm(shin, axis=-1)
            )
            bent = sine > np.sin(0.2)
            assert ((bend * left).sum(-1)[bent] < 0).mean() < 0.01 or not bent.any(), clip.texts[0]
            shoulder, elbow, wrist = (x[:, j + side] for j in (16, 18, 20))
            reach = np.linalg.norm(wrist - shoulder, axis=-1)
            arm = np.linalg.norm(elbow - shoulder, axis=-1) + np.linalg.norm(wrist - elbow, axis=-1)
            assert (reach / arm).max() < 0.99


def test_bones_keep_their_length_motion_is_smooth_and_hands_keep_out_of_the_body(clips: list[Clip]) -> None:
    skeleton = Skeleton.named("smplx52")
    parents = np.array(skeleton.parents[1:])
    rest = np.linalg.norm(skeleton.offsets[1:], axis=-1)
    for clip in clips:
        assert np.isfinite(clip.joints).all() and np.isfinite(clip.face).all()
        bones = np.linalg.norm(clip.joints[:, 1:] - clip.joints[:, parents], axis=-1)
        scale = bones / rest
        assert np.ptp(scale) < 1e-6
        assert 0.9 < scale.mean() < 1.1
        speed = np.linalg.norm(np.diff(clip.joints, axis=0), axis=-1) * FPS
        assert speed.max() < 12.0, clip.texts[0]
        seconds = len(clip.joints) / FPS
        assert CONFIG.min_seconds - 0.1 <= seconds <= CONFIG.max_seconds + 0.1
        # Wrists stay outside a 9 cm cylinder around the spine.
        a, b = clip.joints[:, None, 3], clip.joints[:, None, 12]
        wrists = clip.joints[:, 20:22]
        along = ((wrists - a) * (b - a)).sum(-1) / ((b - a) ** 2).sum(-1)
        gap = np.linalg.norm(wrists - a - np.clip(along, 0, 1)[..., None] * (b - a), axis=-1)
        assert gap.min() > 0.09, clip.texts[0]


def test_a_clip_depends_on_nothing_but_seed_and_index() -> None:
    small, large = SynthConfig(clips=4, seed=9), SynthConfig(clips=999, seed=9)
    for index in (3, 0, 2):
        one, two = make_clip(index, small), make_clip(index, large)
        np.testing.assert_array_equal(one.joints, two.joints)
        np.testing.assert_array_equal(one.face, two.face)
        assert (one.texts, one.face_texts, one.truth) == (two.texts, two.face_texts, two.truth)
    other = make_clip(0, SynthConfig(seed=10))
    assert other.truth != one.truth or len(other.joints) != len(one.joints)


def test_actions_are_balanced_and_splits_have_their_shares() -> None:
    config = SynthConfig(seed=1)
    names = [truth_of(index, config).action for index in range(14 * 20)]
    assert {action: names.count(action) for action in names} == dict.fromkeys(BASIC, 20)
    splits = [split_of(index, config) for index in range(1000)]
    assert abs(splits.count("test") - 150) <= 3
    assert abs(splits.count("val") - 50) <= 3


def test_held_out_combinations_are_in_their_own_split_only() -> None:
    """Some for testing, others for validation; the other clips stay where they are."""
    plain = SynthConfig(seed=1)
    config = SynthConfig(
        seed=1, hold_out=[{"action": "kick", "side": "left"}], hold_out_val=[{"action": "kick", "count": 2}]
    )
    found = Counter[str]()
    for index in range(600):
        truth, split = truth_of(index, config), split_of(index, config)
        if truth.action == "kick" and truth.side == "left":
            assert split == "test"  # what both lists keep is tested
        elif truth.action == "kick" and truth.count == 2:
            assert split == "val"
        else:
            assert split == split_of(index, plain)
            continue
        found[split] += 1
    assert min(found["test"], found["val"]) >= 5


def test_a_combination_that_no_clip_has_is_said(tmp_path: Path) -> None:
    never = [{"action": "squat", "speed": "slowly", "count": 2}, {"action": ["kick"]}, {"side": "lft"}]
    kept = [{"action": "walk"}, {"action": "walk"}]
    config = SynthConfig(clips=2, actions=["walk"], hold_out=[*kept, *never[:2]], hold_out_val=never[2:])
    with pytest.warns(UserWarning) as said:
        synthesize(config, tmp_path / "made", progress=False)
    assert [str(one.message) for one in said] == [f"hold_out: none of 2 clips is of {one}" for one in never]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"actions": ["fly"]}, "fly"),
        ({"hand_shapes": ["claw"]}, "claw"),
        ({"clip": 3}, "did you mean 'clips'"),
        ({"max_seconds": 3.0}, "max_seconds"),
        ({"hold_out": [{"colour": "red"}]}, "colour"),
        ({"hold_out_val": [{"shape": "round"}]}, "shape"),
        ({"val_fraction": 0.6, "test_fraction": 0.5}, "nothing to train"),
        ({"dances": {"tempo": [90, 300]}}, "tempi"),
        ({"dances": {"hold_out_tempi": [[120, 100]]}}, "tempi"),
        ({"dances": {"conditions": {"both": 0}}}, "weight"),
        ({"dances": {}, "actions": ["walk"]}, "share"),
        ({"dances": {"share": 0.5}, "actions": ["dance"]}, "other actions"),
        ({"dances": {"song_seconds": 3}, "min_seconds": 4}, "song_seconds"),
    ],
)
def test_wrong_options_are_named(options: dict[str, object], words: str) -> None:
    with pytest.raises(UserError, match=words):
        SynthConfig.parse(options, "recipe.yaml: synth")


def test_measure_refuses_what_it_cannot_read() -> None:
    with pytest.raises(UserError, match="joints of shape"):
        action_of(np.zeros((10, 5, 3)), FPS)
    with pytest.raises(UserError, match="no 'action'"):
        agrees({}, np.zeros((10, 22, 3)), None, FPS)


def test_shards_are_the_same_for_any_number_of_workers(tmp_path: Path) -> None:
    config = SynthConfig(clips=16, seed=3)
    one = synthesize(config, tmp_path / "one", workers=1, progress=False)
    two = synthesize(config, tmp_path / "two", workers=2, progress=False)
    assert [s.sha256 for s in one.shards] == [s.sha256 for s in two.shards]
    assert sum(s.samples for s in one.shards) == 16 and not one.dropped
    shard = tmp_path / "one" / f"{one.shards[0].name}"
    assert hashlib.sha256(shard.read_bytes()).hexdigest() == one.shards[0].sha256
    dataset = ShardDataset.open(tmp_path / "one", "train")
    meta = dataset.meta(0)
    index = int(meta.id.rsplit("-", 1)[1])
    np.testing.assert_array_equal(dataset.motion(0), make_sample(index, config).motion)
    assert meta.truth == make_clip(index, config).truth


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("kind", ["still", "jump cut", "collapsed"])
def test_judging_a_motion_that_does_nothing(action: str, kind: str) -> None:
    """Generated motions may stand still, jump between two frames or fold into a point; judging goes on."""
    joints = np.repeat(Skeleton.named("smplx52").rest_joints[None], 60, axis=0)
    joints[..., 1] += 0.95
    if kind == "jump cut":
        joints[30:, :, 1] -= 0.4
    elif kind == "collapsed":
        joints *= 0
    claimed = draw(action, np.random.default_rng(0)).record(hands=True, face=False)
    found = agrees(claimed, joints, None, 20.0)
    assert "action" in found and all(isinstance(value, bool) for value in found.values())
