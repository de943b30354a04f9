"""Parts of the synthetic source by themselves: grammar, hands, faces, music, maths."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import find_peaks

from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.synth import face, music
from motionloom.datasets.synth.dance import dance
from motionloom.datasets.synth.gait import ball_at
from motionloom.datasets.synth.grammar import body_captions, face_captions
from motionloom.datasets.synth.hands import shape_hand
from motionloom.datasets.synth.maths import keys, lower_envelope, rot_x, rot_y, rot_z
from motionloom.datasets.synth.measure_hands import hand_shape
from motionloom.datasets.synth.pose import BALL, OFFSETS, SKELETON, Track
from motionloom.datasets.synth.signals import signals_of, tempo
from motionloom.datasets.synth.truth import ACTIONS, FACES, HANDS, Span, Truth, draw

NUMBERS = {1: ("once", "one time"), 2: ("twice", "two times"), 3: ("three times",), 4: ("four times",)}
NUMBERS[5] = ("five times",)


@pytest.mark.parametrize("action", ACTIONS)
def test_every_caption_says_what_decides_the_motion(action: str) -> None:
    for seed in range(60):
        rng = np.random.default_rng(seed)
        truth = draw(action, rng)
        texts = body_captions(truth, rng)
        assert len(texts) == len(set(texts)) >= 2
        for text in texts:
            assert "{" not in text and "None" not in text and "  " not in text
            words = text.replace(",", "").split()
            if truth.side in ("left", "right"):
                assert truth.side in text.split(",")[0].split()
            if truth.side == "both":
                assert "both" in words
            if truth.count is not None:
                assert any(number in text for number in NUMBERS[truth.count])
            if truth.direction in ("left", "right", "up", "down") and "shelf" not in text:
                assert {truth.direction, "floor" if truth.direction == "down" else truth.direction} & set(
                    words
                ) or action == "jump"
            if truth.direction == "clockwise":
                assert "clockwise" in words
            if truth.direction == "counterclockwise":
                assert "counter" in text
            if truth.speed == "slowly":
                assert "slow" in text
            if truth.speed == "quickly":
                assert "quick" in text or "fast" in text
            if truth.bpm:
                assert str(truth.bpm) in words
            for hand, shape in (("left", truth.left_hand), ("right", truth.right_hand)):
                if shape == "relaxed" or (action in ("punch", "wave") and truth.side in (hand, "both")):
                    continue
                assert f"the {hand} hand" in text or "both hands" in text


def test_captions_without_hands_do_not_speak_of_fingers() -> None:
    for seed in range(200):
        rng = np.random.default_rng(seed)
        truth = draw(ACTIONS[seed % len(ACTIONS)], rng)
        for text in body_captions(truth, rng, hands=False):
            assert not {"fingers", "finger", "pinching", "pointing", "fists"} & set(text.split())


@pytest.mark.parametrize("shape", HANDS)
@pytest.mark.parametrize("fps", [20.0, 30.0])
def test_hand_shapes_read_back(shape: str, fps: float) -> None:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        t = np.arange(int(2.5 * fps)) / fps
        local = np.tile(np.eye(3), (len(t), 52, 1, 1))
        local[:, 22:37] = shape_hand(shape, t, rng)
        joints, _ = forward_kinematics(local, np.zeros((len(t), 3)), OFFSETS, SKELETON.parents)
        noisy = joints + rng.normal(0, 0.001, joints.shape)
        assert hand_shape(joints, 0, fps) == shape
        assert hand_shape(noisy, 0, fps) == shape
        np.testing.assert_allclose(np.linalg.det(local[:, 22:37]), 1.0, atol=1e-9)


def test_face_basis_is_orthonormal_and_values_have_unit_order() -> None:
    np.testing.assert_allclose(face.BASIS.T @ face.BASIS, np.eye(8), atol=1e-12)
    t = np.arange(120) / 30
    values = []
    for seed in range(60):
        emotion = FACES[seed % 5]
        x = face.express(emotion, t, np.random.default_rng(seed))
        assert x.shape == (120, 50)
        assert face.read(x) == emotion
        values.append(x)
    assert 0.2 < np.std(values) < 1.5
    assert np.abs(np.diff(np.stack(values), axis=1)).max() < 2.5


@pytest.mark.parametrize("emotion", FACES)
def test_face_captions_name_the_emotion(emotion: str) -> None:
    texts = face_captions(Truth("bow", face=emotion), np.random.default_rng(0))
    roots = {
        "happy": ("happ", "smil"),
        "sad": ("sad", "unhapp"),
        "angry": ("ang",),
        "surprised": ("surpris", "aston"),
    }
    roots["neutral"] = ("neutral", "no emotion", "calm")
    assert len(texts) == 2
    assert all(any(root in text for root in roots[emotion]) for text in texts)


def test_face_captions_are_about_the_person_of_the_body_captions() -> None:
    truth = Truth("jump", face="neutral")
    people = {
        (): {"a person", "a man", "a woman", "someone", "the person", "a figure"},
        ("someone jumps",): {"a person", "a man", "a woman", "someone", "the person", "a figure"},
        ("a woman jumps", "a figure jumps"): {"a person", "a woman", "someone", "the person", "a figure"},
        ("a man jumps", "a woman jumps"): {"a person", "someone", "the person", "a figure"},
    }
    for body, allowed in people.items():
        rng = np.random.default_rng(0)
        texts = [text for _ in range(40) for text in face_captions(truth, rng, body=body)]
        said = {who for who in people[()] if any(text.startswith(f"{who} ") for text in texts)}
        assert said == allowed


@pytest.mark.parametrize("bpm", [80, 105, 140])
def test_music_clicks_on_its_beats(bpm: int) -> None:
    wav = music.render(bpm, 0.2, 4.0, np.random.default_rng(bpm))
    assert wav.dtype == np.float32 and wav.shape == (4 * music.SAMPLE_RATE,)
    assert 0.3 < np.abs(wav).max() <= 1.0
    high = np.abs(np.diff(wav, 2))
    hop = music.SAMPLE_RATE // 200
    energy = high[: len(high) // hop * hop].reshape(-1, hop).mean(1)
    peaks = find_peaks(energy, height=0.4 * energy.max(), distance=40)[0] / 200
    beats = music.beat_times(bpm, 0.2, 4.0)
    inside = beats[(beats > 0.02) & (beats < 3.95)]
    assert len(peaks) >= len(inside) - 1
    for peak in peaks:
        assert np.abs(beats - peak).min() < 0.02


def test_dancers_keep_the_beat() -> None:
    """Body speed has its minima on the beats of the music, and the tempo can be read from the joints."""
    hits = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        truth = draw("dance", rng)
        track = dance(truth, Span(4.0, 6.0), 60.0, rng)
        joints = track.solve()
        speed = np.linalg.norm(np.diff(joints[:, :22], axis=0), axis=-1).mean(1)
        minima = (find_peaks(-speed, prominence=0.2 * speed.std())[0] + 0.5) / 60
        beats = music.beat_times(float(truth.bpm or 0), track.first_beat, float(track.t[-1]))
        inside = beats[(beats > 0.2) & (beats < track.t[-1] - 0.2)]
        hits += [np.abs(minima - beat).min() < 0.05 for beat in inside]
        assert abs(tempo(signals_of(joints, 60.0)) - (truth.bpm or 0)) < 4
    assert np.mean(hits) > 0.95


def test_feet_of_a_standing_person() -> None:
    assert ball_at(0, 0, 0, 0) == pytest.approx(tuple(BALL))
    x, z = ball_at(1.0, 2.0, np.pi / 2, 0)  # facing +X: left is -Z
    assert (x, z) == pytest.approx((1.0 + BALL[1], 2.0 - BALL[0]))


def test_rest_track_is_the_rest_skeleton() -> None:
    track = Track(np.arange(8) / 30, 30.0)
    joints = track.solve()
    np.testing.assert_allclose(joints[:, (10, 11), 1], 0.0, atol=1e-3)
    np.testing.assert_allclose(joints[0, 15, 0], 0.0, atol=1e-9)
    assert (joints[:, 20, 1] < joints[:, 18, 1]).all() and (joints[:, 18, 1] < joints[:, 16, 1]).all()
    mirrored = joints[:, SKELETON.mirror] * np.array([-1.0, 1.0, 1.0])
    np.testing.assert_allclose(mirrored[:, 12:], joints[:, 12:], atol=1e-9)


def test_axis_rotations_turn_the_documented_way() -> None:
    quarter = np.pi / 2
    np.testing.assert_allclose(rot_x(quarter) @ [0, 0, 1], [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(rot_y(quarter) @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(rot_z(quarter) @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_envelope_stays_below_and_keys_are_met() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=200)
    assert (lower_envelope(x, 0.2, 30.0) <= x + 1e-12).all()
    t = np.linspace(0, 3, 301)
    y = keys(t, [0.5, 1.0, 2.0], [1.0, -2.0, 4.0])
    assert y[0] == 1.0 and y[100] == pytest.approx(-2.0) and y[-1] == 4.0
    assert np.abs(np.diff(y)).max() * 100 < 6.0 / 1.0 * 1.9 + 1.0
