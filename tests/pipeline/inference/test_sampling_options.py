"""What a user may ask of generation: lengths, greedy decoding, guidance, steps; what cannot be is refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from toy_stages import MadeStage

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.datasets.text.encoder import EncodedText
from motionloom.models.diffusion.network import DiffusionConfig, MotionDiffusion
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.models.tokenizer.build import build_tokenizer
from motionloom.models.tokenizer.config import H2VQConfig, RvqConfig
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import Finished, Shelf
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.requests import require_used
from motionloom.pipeline.stages.diffusion import DiffusionFace
from motionloom.pipeline.stages.gpt import GptGenerator
from motionloom.pipeline.stages.tma import VaeMotion
from motionloom.pipeline.store.networks import LoadedGpt, TrainedTokenizer

GPT = GptConfig(layers=1, dim=16, heads=2, ff=16, block_size=32)
DENOISER = DiffusionConfig(dim=16, ff=16, layers=1, heads=2)
CAPTIONS = ["a person walks", "jump", "a person sits"]


class Encoder:
    """Fixed random sentences of eight numbers."""

    name, dim = "fixed", 8

    def encode(self, captions: Sequence[str]) -> EncodedText:
        rows = [np.random.default_rng(len(c)).standard_normal(8) for c in captions]
        sentence = np.stack(rows).astype(np.float32)
        return EncodedText(sentence, sentence[:, None], np.ones((len(captions), 1), dtype=np.bool_))


def opinionated(gpt: InterleavedGPT) -> InterleavedGPT:
    """An untrained GPT whose next token depends on the text."""
    gpt.eval().requires_grad_(False)
    gpt.text_in.weight *= 5
    for head in gpt.heads:
        head.weight *= 50
    return gpt


def bundle(
    *, fps: float = 20.0, faces: tuple[str, ...] = (), config: GptConfig = GPT, face: Any = None
) -> Bundle:
    """An untrained model; `face` is the config of its face generators' networks."""
    torch.manual_seed(0)
    layout = MotionLayout.named("wholebody363", fps=fps)
    stats = FeatureStats(np.zeros(363, np.float32), np.ones(363, np.float32), layout)
    given = {"stats": stats, "text": SimpleNamespace(encoder=Encoder())}
    small = {"width": 8, "depth": 1, "code_dim": 8, "num_codes": 8}
    tokenizer = build_tokenizer(H2VQConfig(**small), layout).freeze()
    gpt = opinionated(InterleavedGPT(config, tokenizer.streams, tokenizer.pattern, 8))

    def of(levels: Any, net: InterleavedGPT, face: bool) -> GptGenerator:
        trained = {"tokenizer": TrainedTokenizer(levels, given), "text": given["text"]}
        return GptGenerator(LoadedGpt(net, "sentence"), trained, face)

    made: list[Any] = [of(tokenizer, gpt, False)]
    if "gpt" in faces:
        levels = build_tokenizer(RvqConfig(part="face", **small), layout).freeze()
        net = opinionated(InterleavedGPT(face or GPT, levels.streams, levels.pattern, 8))
        made.append(of(levels, net, True))
    if "diffusion" in faces:
        denoiser = MotionDiffusion(face or DENOISER, 50, 8)
        made.append(DiffusionFace(denoiser.eval().requires_grad_(False), layout, given))
    if "vae" in faces:
        made.append(VaeMotion(SimpleNamespace(given=given, part="face")))  # type: ignore[arg-type]
    return Bundle([stage(f"stage{k}", one) for k, one in enumerate(made)], Shelf())


def stage(name: str, made: Any, **given: Any) -> Finished:
    """A finished stage that gives `made`, and those that feed it."""
    above = {role: stage(role, SimpleNamespace(encoder=one)) for role, one in given.items()}
    return Finished(name, MadeStage(made), None, Path(name), above)


def test_a_length_for_each_caption() -> None:
    model = bundle()
    made = model.generate(CAPTIONS, seconds=[0.4, 1.0, 0.2], seed=1, batch=2)
    assert [len(motion.joints) for motion in made] == [8, 20, 4]
    for row, motion in enumerate(model.generate(CAPTIONS, seconds=1.0, seed=1)):
        assert len(motion.joints) == 20
        if row == 1:
            np.testing.assert_allclose(motion.features, made[1].features, atol=1e-5)
    with pytest.raises(UserError, match="3 captions but 2 lengths"):
        model.generate(CAPTIONS, seconds=[1.0, 1.0])


@pytest.mark.parametrize(("fps", "least"), [(20.0, "0.2"), (30.0, "0.13")])
def test_lengths_out_of_reach_are_refused_with_the_true_range(fps: float, least: str) -> None:
    model = bundle(fps=fps)
    for seconds in (99.0, -1.0, float("nan"), float("inf"), [1.0, 1.0, 99.0]):
        with pytest.raises(UserError, match=f"this model makes {least} to {model.max_seconds:.1f} s"):
            model.generate(CAPTIONS, seconds=seconds)
    assert len(model.generate(CAPTIONS[:1], seconds=float(least))[0].joints) == 4


def test_temperature_zero_is_greedy() -> None:
    model, greedy = bundle(faces=("gpt",)), SamplingConfig(temperature=0)
    first, second = (model.generate(CAPTIONS, seconds=1.0, seed=s, sampling=greedy) for s in (1, 2))
    drawn = model.generate(CAPTIONS, seconds=1.0, seed=2)
    for one, other, free in zip(first, second, drawn, strict=True):
        np.testing.assert_array_equal(one.features, other.features)
        np.testing.assert_array_equal(one.face, other.face)
        assert not np.array_equal(one.features, free.features)
    narrow = SamplingConfig(temperature=0, top_p=0.1, top_k=1)
    np.testing.assert_array_equal(
        model.generate(CAPTIONS, seconds=1.0, sampling=narrow)[0].features, first[0].features
    )


@pytest.mark.parametrize("kind", ["gpt", "diffusion"])
def test_the_face_has_its_own_guidance(kind: str) -> None:
    model = bundle(faces=(kind,))

    def made(**options: float) -> Any:
        sampling = SamplingConfig(denoising_steps=4, **options)
        return model.generate(CAPTIONS[:1], seconds=1.0, seed=3, sampling=sampling)[0]

    plain, both = made(), made(cfg_scale=4.0)
    body, face = made(cfg_scale=4.0, face_cfg_scale=1.0), made(face_cfg_scale=4.0)
    np.testing.assert_array_equal(body.features, both.features)
    np.testing.assert_array_equal(body.face, plain.face)
    np.testing.assert_array_equal(face.features, plain.features)
    np.testing.assert_array_equal(face.face, both.face)
    assert not np.array_equal(plain.face, both.face) and not np.array_equal(plain.features, both.features)


@pytest.mark.parametrize("kind", ["gpt", "diffusion"])
def test_guidance_of_a_face_that_never_trained_without_text_is_refused(kind: str) -> None:
    config: Any = GPT if kind == "gpt" else DENOISER
    model = bundle(faces=(kind,), face=config.model_copy(update={"condition_dropout": 0.0}))
    with pytest.raises(UserError, match=r"trained with condition_dropout > 0; .*face_cfg_scale"):
        model.generate(CAPTIONS, seconds=1.0, sampling=SamplingConfig(cfg_scale=2.0))
    fine = SamplingConfig(cfg_scale=2.0, face_cfg_scale=1.0, denoising_steps=2)
    assert len(model.generate(CAPTIONS, seconds=1.0, sampling=fine)) == 3


@pytest.mark.parametrize("sampler", ["ddpm", "ddim", "dpm++"])
def test_more_steps_than_were_trained_are_refused(sampler: Any) -> None:
    model = bundle(faces=("diffusion",))
    asked = SamplingConfig(sampler=sampler, denoising_steps=2000)
    with pytest.raises(UserError, match="2000 denoising steps are more than the 1000"):
        model.generate(CAPTIONS[:1], seconds=0.2, sampling=asked)
    once = SamplingConfig(sampler=sampler, denoising_steps=1)
    face = model.generate(CAPTIONS[:1], seconds=0.2, sampling=once)[0].face
    assert face is not None and np.isfinite(face).all()


WRONG_ASKS: dict[str, tuple[tuple[str, ...], dict[str, Any], str]] = {
    "one text": ((), {"captions": "wave"}, r"captions is one text; give a list, also of one: .*\['wave'\]"),
    "one face text": ((), {"face": "abc"}, r"face is one text; .*\['abc'\]"),
    "no text": ((), {"captions": ["a", 3, "b"]}, r"captions\[1\] = 3: not a text"),
    "empty": ((), {"captions": ["a", " ", "b"]}, r"captions\[1\] is empty"),
    "negative seed": ((), {"seed": -1}, "seed -1: a seed is a whole number"),
    "broken seed": ((), {"seed": 0.5}, "seed 0.5: a seed is a whole number"),
    "misspelt sampling": ((), {"sampling": {"topp": 0.9}}, "unknown key 'topp'; did you mean 'top_p'"),
    "no sampling": ((), {"sampling": 3}, "sampling: "),
    "face of no face": ((), {"face": CAPTIONS}, "this model makes no face"),
    "guidance of no face": ((), {"sampling": {"face_cfg_scale": 3.0}}, "this model makes no face"),
    "steps of no face": (
        (),
        {"sampling": {"denoising_steps": 9}},
        r"\(--denoising-steps\): no generator that is used here takes it; leave it out",
    ),
    "sampler of a GPT": (("gpt",), {"sampling": {"sampler": "ddim"}}, r"\(--sampler\): .*; leave it out"),
    "steps beside a diffusion model": (
        ("gpt", "diffusion"),
        {"sampling": {"denoising_steps": 9}},
        "choose --face-model diffusion",
    ),
}


@pytest.mark.parametrize("name", WRONG_ASKS)
def test_what_has_no_sense_or_no_effect_is_refused(name: str) -> None:
    faces, asked, says = WRONG_ASKS[name]
    with pytest.raises(UserError, match=says):
        bundle(faces=faces).generate(**{"captions": CAPTIONS, "seconds": 0.2, "strict": True, **asked})


def test_a_face_by_a_vae_takes_no_guidance() -> None:
    model = bundle(faces=("vae",))
    require_used(model, CAPTIONS, SamplingConfig(cfg_scale=2.0))
    with pytest.raises(UserError, match=r"\(--face-cfg-scale\): no generator .* takes it; leave it out"):
        require_used(model, CAPTIONS, SamplingConfig(face_cfg_scale=2.0))
    both = bundle(faces=("vae", "gpt"))
    assert list(both.faces) == ["gpt", "vae"]
    with pytest.raises(
        UserError, match=r"\(--face-cfg-scale\): .*; choose --face-model gpt, or leave it out"
    ):
        require_used(both, CAPTIONS, SamplingConfig(face_cfg_scale=2.0, face_model="vae"))


def test_a_face_is_chosen_by_its_method_or_its_stage() -> None:
    model = bundle(faces=("gpt", "diffusion"))
    assert model.choose_face(None) == model.choose_face("gpt") == model.choose_face("stage1")
    assert model.choose_face("diffusion") == model.choose_face("stage2") == model.stages[2]
    with pytest.raises(UserError, match="no face generator 'vae' here; there is gpt, diffusion"):
        model.choose_face("vae")


def test_what_is_asked_without_words_is_refused() -> None:
    """Also where empty captions are not refused as such: there is nothing to make a motion of."""
    for captions in ([""], ["a person walks", " "]):
        with pytest.raises(UserError, match=rf"captions\[{len(captions) - 1}\] is empty"):
            bundle().generate(captions, seconds=0.2)
    with pytest.raises(UserError, match="nothing to generate from: give captions, sounds or both"):
        bundle().generate()


def test_sampling_may_be_a_mapping() -> None:
    model, asked = bundle(faces=("gpt", "diffusion")), {"top_p": 0.5, "temperature": 2.0}
    ours, theirs = (
        model.generate(CAPTIONS, seconds=0.4, seed=1, sampling=sampling, strict=True)
        for sampling in (asked, SamplingConfig(**asked))
    )
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one.features, other.features)
    steps = {"denoising_steps": 2, "face_model": "diffusion"}
    assert len(model.generate(CAPTIONS, seconds=0.2, sampling=steps, strict=True)) == 3


def test_the_commands_options_reach_the_sampling(
    call: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    seen: dict[str, Any] = {}
    monkeypatch.setattr("motionloom.pipeline.inference.bundle.Bundle.open", lambda *_: _Watching(seen))
    monkeypatch.setattr("motionloom.pipeline.inference.unknown.unknown_captions", lambda *_: [])
    words = (
        "--sampler",
        "dpm++",
        "--denoising-steps",
        "7",
        "--cfg-scale",
        "3",
        "--face-cfg-scale",
        "1.5",
        "--temperature",
        "0",
    )
    words += ("--music-cfg-scale", "1.2")
    assert call("generate", "somewhere", "a person walks", *words, "-o", tmp_path, "-f", "npz").code == 0
    assert seen["sampling"] == SamplingConfig(
        sampler="dpm++", denoising_steps=7, cfg_scale=3, face_cfg_scale=1.5, music_cfg_scale=1.2,
        temperature=0,
    )  # fmt: skip
    assert seen["strict"] and seen["sampling"].model_fields_set >= {"sampler", "denoising_steps"}
    assert call("generate", "somewhere", "a person walks", "-o", tmp_path, "-f", "npz").code == 0
    assert not seen["sampling"].model_fields_set & {"sampler", "denoising_steps", "face_cfg_scale"}
    wrong = call("generate", "somewhere", "a person walks", "--sampler", "euler")
    assert wrong.code == 2 and "sampler" in wrong.err and "ddim" in wrong.err


class _Watching:
    """Stands in for a model; keeps what it was asked."""

    def __init__(self, seen: dict[str, Any]) -> None:
        self.seen = seen

    def generate(self, captions: Sequence[str], **options: Any) -> list[Any]:
        self.seen.update(options)
        return []
