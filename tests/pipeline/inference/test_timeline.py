"""Tokens along a time line: windows, the music they see, borders of stretches, seeds, batches, z."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from motionloom.datasets.audio import features
from motionloom.datasets.audio.features import features_of
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.conditions import Condition, Conditions
from motionloom.datasets.modalities.modality import FrameStats
from motionloom.datasets.synth.dances import DanceConfig
from motionloom.datasets.synth.music.recording import render_song
from motionloom.models.condition.mate import MateConfig
from motionloom.models.gpt.rows import Drawing
from motionloom.models.gpt.tokens import Codes
from motionloom.models.tokenizer.base import Stream
from motionloom.models.utt.network import ConditionedUtt, UttConfig
from motionloom.models.utt.sampling import draw_z, generate
from motionloom.pipeline.contract.generation import Prompt, Stretch
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.generation import encode_prompts
from motionloom.pipeline.inference.generators.timeline import TokenTimeline
from motionloom.pipeline.inference.request import Request

PATTERN = ("body", "body", "hand")
STREAMS = (Stream("body", 7, 2), Stream("hand", 5, 1))
WINDOW, CONTEXT = 6, 2
SEEDS = [11, 2**63 + 5, 13, 14]
MEAN, STD = 3.0, 2.0
GREEDY = SamplingConfig(temperature=0.0)


@pytest.fixture(scope="module")
def net() -> ConditionedUtt:
    torch.manual_seed(0)
    made = ConditionedUtt(
        MateConfig(dim=8, layers=1, heads=2, ff=16),
        UttConfig(layers=1, dim=16, heads=2, ff=32, block_size=WINDOW * 3 + 2, z_dim=3),
        {"text": 4, "audio": 2},
        STREAMS,
        PATTERN,
        timed=["audio"],
    )
    for head in made.utt.heads:
        torch.nn.init.normal_(head.weight, std=0.7)  # peaked, so that a mix-up would show
    torch.nn.init.normal_(made.utt.condition_in.weight, std=2.0)
    return made.double().eval()


@pytest.fixture(scope="module")
def timeline(net: ConditionedUtt) -> TokenTimeline:
    return line_of(net)


def line_of(net: ConditionedUtt, **settings: Any) -> TokenTimeline:
    stats = FrameStats(np.full(2, MEAN, np.float32), np.full(2, STD, np.float32), 100)
    given = {"window_groups": WINDOW, "context": CONTEXT, "prepared": {"audio": stats}, "inject_z": True}
    return TokenTimeline(net, **{**given, **settings})


def text(rows: int, seed: int = 0, words: int = 3) -> Conditions:
    features = torch.randn(rows, words, 4, generator=torch.Generator().manual_seed(seed)).double()
    return {"text": Condition(features, torch.ones(rows, words, dtype=torch.bool), features.mean(1))}


def music(rows: int, frames: list[int]) -> Conditions:
    """Frame t of row b has the features (t, b)."""
    most = max(frames)
    features = torch.stack(
        [torch.arange(most).expand(rows, -1), torch.arange(rows)[:, None].expand(-1, most)], -1
    ).double()
    return {"audio": Condition(features, torch.arange(most) < torch.tensor(frames)[:, None])}


def row_of(conditions: Conditions, row: int) -> Conditions:
    return {
        name: Condition(f[row : row + 1], m[row : row + 1], None if p is None else p[row : row + 1])
        for name, (f, m, p) in conditions.items()
    }


def codes_of(codes: Codes, row: int) -> dict[str, list[int]]:
    count = int(codes.groups[row])
    return {s.name: codes.codes[s.name][row, : count * s.per_group].tolist() for s in STREAMS}


def test_free_length_is_a_plain_generate_and_stands_alone(
    timeline: TokenTimeline, net: ConditionedUtt
) -> None:
    made = timeline.tokens([Stretch(text(4), None)], SEEDS, SamplingConfig())
    plain = generate(net.utt, net.mate(text(4)), max_groups=WINDOW, how=Drawing(top_p=0.95), seed=SEEDS)
    assert all(codes_of(made, row) == codes_of(plain, row) for row in range(4))


def test_music_for_a_model_without_is_refused(net: ConditionedUtt) -> None:
    with pytest.raises(UserError, match="trained without audio"):
        line_of(net, prepared={}).tokens([Stretch(music(1, [8]), [8])], SEEDS[:1], GREEDY)


def windows_by_hand(before: int, wanted: int) -> list[tuple[int, int, int]]:
    """(groups seen, first frame of the window in its stretch, new groups) of each window of one row."""
    out, done = [], 0
    while done < wanted:
        seen = min(CONTEXT, before + done)
        new = min(wanted - done, WINDOW - seen)
        out.append((seen, 4 * (done - seen), new))
        done += new
    return out


def slow(
    net: ConditionedUtt, stretches: list[Stretch], row: int, seed: int, inject_z: bool
) -> list[list[int]]:
    """One row, greedy, window by window with lists; the slots of each group are a list."""
    z = draw_z([seed], 3) if inject_z else None
    groups: list[list[int]] = []
    for stretch in stretches:
        own, wanted = row_of(stretch.conditions, row), -(-list(stretch.frames or [])[row] // 4)
        for seen, first, new in windows_by_hand(len(groups), wanted):
            here = dict(own)
            if "audio" in own:
                features, mask, _ = own["audio"]
                frames = range(first, first + 4 * (seen + new))
                keep = [t for t in frames if 0 <= t < int(mask.sum())]
                piece, real = torch.zeros(1, len(frames), 2).double(), torch.zeros(1, len(frames)).bool()
                for t in keep:
                    piece[0, t - first], real[0, t - first] = (features[0, t] - MEAN) / STD, True
                here["audio"] = Condition(piece, real)
            last = groups[len(groups) - seen :]
            start = Codes(
                {
                    "body": torch.tensor([[c for g in last for c in g[:2]]], dtype=torch.int64),
                    "hand": torch.tensor([[g[2] for g in last]], dtype=torch.int64),
                },
                torch.tensor([seen]),
            )
            made = generate(
                net.utt, net.mate(here), inject_z=inject_z, z=z, start=start, groups=torch.tensor([new]),
                how=Drawing(0), seed=[seed],
            )  # fmt: skip
            body, hand = made.codes["body"][0].tolist(), made.codes["hand"][0].tolist()
            groups += [[body[2 * k], body[2 * k + 1], hand[k]] for k in range(new)]
    return groups


def test_music_has_its_own_guidance(timeline: TokenTimeline, net: ConditionedUtt) -> None:
    """Rows with music take it, rows of words alone do not."""
    given = {**text(4), **music(4, [24, 0, 24, 0])}
    frames, mean = [24] * 4, SamplingConfig(cfg_scale=3.0, guidance={"audio": 1.0})
    made = timeline.tokens([Stretch(given, frames)], SEEDS, mean)
    for sampling, rows in ((SamplingConfig(), (0, 2)), (SamplingConfig(cfg_scale=3.0), (1, 3))):
        plain = timeline.tokens([Stretch(given, frames)], SEEDS, sampling)
        for at in range(4):
            assert (codes_of(made, at) == codes_of(plain, at)) == (at in rows)


@pytest.fixture(scope="module")
def show() -> list[Stretch]:
    """Text, music, both, text; four rows of different lengths."""
    both = {**text(4, seed=2), **music(4, [40, 40, 33, 12])}
    return [
        Stretch(text(4, seed=1), [8, 4, 60, 12]),
        Stretch(music(4, [200, 37, 64, 8]), [120, 37, 8, 8]),
        Stretch(both, [40, 8, 33, 12]),
        Stretch(text(4, seed=3, words=1), [4, 44, 16, 8]),
    ]


@pytest.mark.parametrize("inject_z", [True, False])
def test_a_show_equals_the_slow_version(net: ConditionedUtt, show: list[Stretch], inject_z: bool) -> None:
    """Windows see their frames of the music and the last groups before them; z is one over the motion."""
    made = line_of(net, inject_z=inject_z).tokens(show, SEEDS, GREEDY)
    for row, seed in enumerate(SEEDS):
        expected = slow(net, show, row, seed, inject_z)
        assert int(made.groups[row]) == len(expected)
        found = codes_of(made, row)
        assert found["body"] == [code for group in expected for code in group[:2]]
        assert found["hand"] == [group[2] for group in expected]


@pytest.mark.parametrize(
    "sampling",
    [
        SamplingConfig(),
        SamplingConfig(cfg_scale=1.7, top_k=4),
        SamplingConfig(cfg_scale=1.7, guidance={"audio": 1.0}),
    ],
)
def test_batches_play_no_part(timeline: TokenTimeline, show: list[Stretch], sampling: SamplingConfig) -> None:
    """Neither the other rows nor their lengths; and the same seeds give the same tokens."""
    together, again = (timeline.tokens(show, SEEDS, sampling) for _ in range(2))
    other = timeline.tokens(show, [seed + 1 for seed in SEEDS], sampling)
    for row, seed in enumerate(SEEDS):
        alone = [Stretch(row_of(s.conditions, row), [list(s.frames or [])[row]]) for s in show]
        mine = codes_of(timeline.tokens(alone, [seed], sampling), 0)
        assert mine == codes_of(together, row) == codes_of(again, row) != codes_of(other, row)


# What a model hears of music: features of whole pieces, the same for a slice of one, heard once.


FPS, RATE = 20.0, 16_000
DANCER: Any = SimpleNamespace(modalities=frozenset({"audio"}), prepared={})


@pytest.fixture(scope="module")
def song() -> Sound:
    config = DanceConfig(songs=2, song_seconds=12.0)
    return Sound(render_song(config.song(0, 3), RATE), RATE)


def heard(sounds: list[Sound]) -> list[np.ndarray]:
    prompts = [Prompt(sound=sound) for sound in sounds]
    found = encode_prompts(DANCER, prompts, [""] * len(sounds), FPS, torch.device("cpu"))["audio"]
    return [f[m].numpy() for f, m in zip(found.features, found.mask, strict=True)]


@pytest.mark.slow
def test_a_slice_is_heard_as_its_piece_is(song: Sound) -> None:
    whole = features_of(song, FPS)
    part = song.slice(4.0, 8.5)
    assert part.piece is song
    (found,) = heard([part])
    assert np.array_equal(found, whole[80:170])
    # Heard alone it would be another music: the tempogram alone spans many seconds.
    alone = features_of(Sound(part.samples, RATE), FPS)
    assert np.abs(alone - whole[80:170])[:, 54:].mean() > 0.01


@pytest.mark.slow
def test_a_slice_of_a_slice_and_one_between_two_frames(song: Sound) -> None:
    inner = song.slice(2.0).slice(2.0, 6.5)
    assert inner.piece is song and inner.begin == 4.0
    assert np.array_equal(heard([inner])[0], heard([song.slice(4.0, 8.5)])[0])
    assert np.array_equal(heard([inner.resampled(8_000)])[0], heard([inner])[0])
    between = song.slice(4.02, 8.52)
    moved = song.slice(0.02)
    rows = features_of(Sound(moved.samples, RATE), FPS)
    assert np.array_equal(heard([between])[0], rows[80:170])


@pytest.mark.slow
def test_pieces_are_heard_once(song: Sound, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    real = features.audio_features

    def counted(samples: np.ndarray, *rest: object) -> np.ndarray:
        calls.append(len(samples))
        return real(samples, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(features, "audio_features", counted)
    song = Sound(song.samples, song.rate)
    heard([song, song, song.slice(1.0, 3.0)])
    heard([song.slice(3.0, 5.0)])
    assert calls == [len(song.samples)]


@pytest.mark.slow
def test_known_features_are_taken_as_they_are(song: Sound) -> None:
    rows = np.random.default_rng(0).normal(size=(30, 438)).astype(np.float32)
    prompts = Request.of(sounds=[song, song], conditions={"audio": [rows, None]}).prompts
    found = encode_prompts(DANCER, prompts, ["", ""], FPS, torch.device("cpu"))
    assert found["audio"].mask.sum(1).tolist() == [30, round(song.seconds * FPS)]
    assert np.array_equal(found["audio"].features[0, :30].numpy(), rows)
    with pytest.raises(UserError, match="2 sounds but 1 audio"):
        Request.of(sounds=[song, song], conditions={"audio": [rows]})
