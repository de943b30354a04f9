"""Streams of trained models beside the whole motions of the same seeds; captions on the way; JSON lines."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.schema import UserError
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.motion import MotionChunk, joined
from motionloom.pipeline.inference.script import Script, ScriptSegment

pytestmark = pytest.mark.slow

NEAR = 2e-5
"""float32 networks: a few hundred roundings of 6e-8 on values of about one, in another order for windows of
another length. In float64 the decoders agree to 1e-11 (tests/models/tokenizer/test_stream_decoder.py)."""


@pytest.fixture(scope="module")
def model(small_run: Any) -> MotionModel:
    return MotionModel.from_pretrained(small_run.folder, device="cpu")


@pytest.fixture(scope="module")
def ude(ude_run: Any) -> MotionModel:
    """Without its diffusion decoder, whose windows a stream denoises one by one."""
    made = MotionModel.from_pretrained(ude_run.folder, device="cpu")
    bundle = made.bundle
    bundle._generators[bundle.main.folder] = replace(bundle.generator, dmd=None)  # type: ignore[type-var]
    return made


def two(*captions: tuple[str, float]) -> Script:
    """Captions one after another."""
    return Script(segments=[ScriptSegment(text=text, seconds=seconds) for text, seconds in captions])


def whole(chunks: list[MotionChunk]) -> Any:
    """One motion of chunks that follow each other."""
    ends = list(itertools.accumulate(len(chunk.joints) for chunk in chunks))
    assert [chunk.start for chunk in chunks] == [0, *ends[:-1]]
    return joined(chunks)


def same(made: Any, wanted: Any) -> None:
    np.testing.assert_allclose(made.features, wanted.features, rtol=0, atol=NEAR)
    # The root's way adds up the roundings of all frames before.
    np.testing.assert_allclose(made.joints, wanted.joints, rtol=0, atol=NEAR * len(made.joints))
    assert (made.face is None) == (wanted.face is None)
    if wanted.face is not None:
        np.testing.assert_allclose(made.face, wanted.face, rtol=0, atol=NEAR)


@pytest.mark.parametrize("chunk_frames", [4, 11])
def test_one_caption_is_what_generate_makes(model: MotionModel, chunk_frames: int) -> None:
    """As long as a clip is: where one would end a stream goes on, and `generate` draws to its length."""
    sampling = {"cfg_scale": 2.0, "temperature": 0.8}
    stream = model.stream(
        "a person waves", face="a person looks sad", seconds=1.8, seed=5, sampling=sampling,
        streaming={"chunk_frames": chunk_frames},
    )  # fmt: skip
    chunks = list(stream)
    assert len(chunks) > 1 and all(len(chunk.joints) >= chunk_frames for chunk in chunks[:-1])
    wanted = model.generate(
        ["a person waves"], face=["a person looks sad"], seconds=1.8, seed=5, sampling=sampling
    )
    same(whole(chunks), wanted[0])
    assert chunks[0].caption == "a person waves" and chunks[0].prompt.words == "a person looks sad"


def test_frames_are_those_of_all_tokens_at_once(model: MotionModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the network's block and across captions: its own tokens, decoded in one piece."""
    tokenizer = model.bundle.generator.tokenizer  # type: ignore[attr-defined]
    stream, drawn = model.stream(two(("a person walks", 14.0), ("a person sits", 3.0)), seed=2), []
    flow = stream._body._flow
    draw = type(flow).draw

    def recorded(one: Any, left: int | None) -> Any:
        group = draw(one, left)
        if one is flow:  # and not the face's
            drawn.append(group)
        return group

    monkeypatch.setattr(type(flow), "draw", recorded)
    made = whole(list(stream))
    import torch

    codes = {name: torch.cat([group[name] for group in drawn], 1) for name in drawn[0]}
    np.testing.assert_allclose(tokenizer.decode(codes, [85])[0], made.features, rtol=0, atol=NEAR)
    assert [tuple(span[:3]) for span in made.segments] == [
        (0.0, 14.0, "a person walks"),
        (14.0, 17.0, "a person sits"),
    ]
    assert model.max_seconds < 14.0


def test_another_caption_on_the_way(model: MotionModel) -> None:
    stream = model.stream("a person walks", seed=1)
    before = [next(stream) for _ in range(3)]
    stream.say("a person jumps", seconds=2.0)
    after = list(itertools.islice(stream, 40))  # ends after the two seconds
    chunks = [*before, *after]
    motion = whole(chunks)
    assert [span.label for span in motion.segments] == ["a person walks", "a person jumps"]
    assert motion.segments[1].end - motion.segments[1].start == pytest.approx(2.0)
    plain = whole(list(model.stream("a person walks", seed=1, seconds=motion.segments[0].end)))
    reach = model.bundle.generator.tokenizer.net.reach * 4  # type: ignore[attr-defined]
    kept = round(motion.segments[0].end * motion.fps) - reach
    assert kept > 0  # up to what the decoder looks ahead, nothing has changed
    np.testing.assert_allclose(motion.features[:kept], plain.features[:kept], rtol=0, atol=NEAR)
    assert next(stream, None) is None


def test_it_goes_on_until_it_is_closed(model: MotionModel) -> None:
    stream = model.stream("a person walks")
    frames = sum(len(next(stream).joints) for _ in range(30))
    stream.close()
    rest = sum(len(chunk.joints) for chunk in stream)
    reach = max(maker.generator.tokenizer.net.reach for maker in (stream._body, stream._face) if maker) * 4
    assert frames > 200 and 0 < rest <= reach + 16
    assert stream._body._frames.nbytes < 100_000 and len(stream._bounds) == 1


@pytest.mark.parametrize(
    ("captions", "options", "words"),
    [
        ("", {}, "captions[0] is empty"),
        (two(("a", 0.01), ("b", 1.0)), {}, "the shortest this model makes is"),
        (two(("a", 1.0), ("b", 1.0)), {"face": "x"}, "a script says everything"),
        ("a", {"seconds": 0.0}, "above 0"),
        ("a", {"sound": Sound(np.full(100, 0.1, np.float32), 100)}, "conditioned on text only"),
        ("a", {"seed": -1}, "a seed is a whole number"),
        ("a", {"sampling": {"face_model": "diffusion"}}, "makes a motion as a whole"),
        ("a", {"streaming": {"chunk": 1}}, "unknown key 'chunk'"),
    ],
    ids=str,
)
def test_refusals(model: MotionModel, captions: Any, options: dict[str, Any], words: str) -> None:
    with pytest.raises(UserError) as error:
        next(model.stream(captions, **options))
    assert words in str(error.value)


def song(seconds: float) -> Sound:
    t = np.arange(round(seconds * 22_050)) / 22_050
    click = 0.7 * np.sin(2 * np.pi * 1500 * (t % 0.5)) * np.exp(-(t % 0.5) * 400)
    return Sound((0.1 * np.sin(2 * np.pi * 220 * t) + click).astype(np.float32), 22_050)


def test_a_script_of_text_and_music_is_what_perform_makes(ude: MotionModel, tmp_path: Path) -> None:
    import soundfile

    soundfile.write(tmp_path / "song.wav", song(6.0).samples, 22_050)
    music = str(tmp_path / "song.wav")
    script = Script(
        segments=[
            ScriptSegment(text="a person walks", seconds=5),
            ScriptSegment(music=f"{music}@1-5.6"),
            ScriptSegment(text="a person waves", music=f"{music}@0-2"),
        ]
    )
    chunks = list(ude.stream(script, seed=4))
    same(whole(chunks), ude.perform(script, seed=4)[0])
    kinds = {chunk.prompt.modalities for chunk in chunks}
    assert kinds == {frozenset({"text"}), frozenset({"audio"}), frozenset({"text", "audio"})}


def test_a_dance_without_an_end_of_its_own(ude: MotionModel) -> None:
    same(whole(list(ude.stream(sound=song(5.0), seed=3))), ude.generate(sounds=[song(5.0)], seed=3)[0])
    stream = ude.stream("a person walks", seed=3, streaming={"hop_frames": 8})
    assert next(stream).caption == "a person walks"
    stream.say("a person waves")
    assert list(itertools.islice(stream, 8))[-1].caption == "a person waves"


def test_windows_of_the_diffusion_decoder(ude_run: Any, ude: MotionModel) -> None:
    """Of the same tokens, in whatever pieces they come."""
    model = MotionModel.from_pretrained(ude_run.folder, device="cpu")
    captions = two(("a person walks", 5.0), ("a person waves", 2.0))
    made = [whole(list(model.stream(captions, seed=2, streaming={"hop_frames": hop}))) for hop in (4, 40)]
    assert len(made[0].joints) == 140
    np.testing.assert_array_equal(made[0].features, made[1].features)
    plain = whole(list(model.stream(captions, seed=2, streaming={"decoder": "tokenizer"})))
    same(plain, whole(list(ude.stream(captions, seed=2))))
    assert plain.features.shape == made[0].features.shape and (plain.features != made[0].features).any()
    first = next(model.stream("a person walks", seed=2, streaming={"decoder": "diffusion"}))
    assert 0 < len(first.joints) < model.bundle.generator.dmd.window  # type: ignore[attr-defined]
    with pytest.raises(UserError, match="has no diffusion decoder"):
        ude.stream("a person walks", streaming={"decoder": "diffusion"})


def read(text: str) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    lines = [json.loads(line) for line in text.splitlines()]
    return lines[0], lines[1:]


def test_json_lines_of_the_command(
    model: MotionModel, small_run: Any, call: Callable[..., Any], tmp_path: Path
) -> None:
    out = tmp_path / "made.jsonl"
    words = ["a person waves", "a person walks", "--seconds", "1.2", "--seed", "3"]
    done = call("generate", small_run.folder, *words, "-f", "jsonl", "-o", out)
    assert done.code == 0 and not done.out and "48 frames, 2.4 s of motion" in done.err
    head, frames = read(out.read_text())
    assert head["fps"] == 20.0 and len(head["joint_names"]) == len(head["parents"]) == 52
    assert [frame["frame"] for frame in frames] == list(range(48))
    assert [frame["caption"] for frame in frames] == ["a person waves"] * 24 + ["a person walks"] * 24
    made = whole(list(model.stream(two(("a person waves", 1.2), ("a person walks", 1.2)), seed=3)))
    np.testing.assert_allclose([frame["joints"] for frame in frames], made.joints, rtol=0, atol=1.1e-5)
    np.testing.assert_allclose([frame["face"] for frame in frames], made.face, rtol=0, atol=1.1e-5)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("-f", "jsonl"), "caption"),
        (("a", "b", "-f", "jsonl"), "--seconds"),
        (("a", "--samples", "2", "-f", "jsonl"), "--samples"),
        (("a", "--format", "npz,jsonl"), "--format"),
    ],
)
def test_what_a_stream_is_not(words: tuple[str, ...], sentence: str, call: Callable[..., Any]) -> None:
    done = call("generate", "nowhere", *words)
    assert done.code == 2 and sentence in done.err
