"""What a user may ask of generation: lengths, greedy decoding, guidance, steps, draws to choose from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from toy_stages import FixedEncoder, MadeStage

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.diffusion.network import TextDenoiserConfig
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.models.tokenizer.body_hand import H2VQConfig
from motionloom.models.tokenizer.single import RvqConfig
from motionloom.pipeline.baselines.mdm.network import Mdm
from motionloom.pipeline.contract.generation import Capabilities, GenerationRequest, Prompt
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import CompletedStage, StageCache
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.generation import encode, generate
from motionloom.pipeline.inference.generators.diffusion import DiffusionMotion
from motionloom.pipeline.inference.generators.gpt import GptGenerator, candidate_seeds, repeated
from motionloom.pipeline.inference.generators.ude import UdeGenerator
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.request import Request
from motionloom.pipeline.inference.shipped_models import shipped_models
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.stages.networks.tma import VaeMotion
from motionloom.pipeline.stages.results.evaluate_units import EvaluateConfig
from motionloom.pipeline.store.artifact import Terms
from motionloom.pipeline.store.networks import LoadedGpt, TrainedTokenizer

GPT = GptConfig(layers=1, dim=16, heads=2, ff=16, block_size=32)
DENOISER = TextDenoiserConfig(dim=16, ff=16, layers=1, heads=2)
CAPTIONS = ["a person walks", "jump", "a person sits"]


def opinionated(gpt: InterleavedGPT) -> InterleavedGPT:
    """An untrained GPT whose next token depends on the text."""
    gpt.eval().requires_grad_(False)
    gpt.text_in.weight *= 5
    for head in gpt.heads:
        head.weight *= 50
    return gpt


def untrained(
    *, fps: float = 20.0, faces: tuple[str, ...] = (), config: GptConfig = GPT, face: Any = None
) -> MotionModel:
    """An untrained model; `face` is the config of its face generators' networks."""
    torch.manual_seed(0)
    layout = MotionLayout.named("wholebody363", fps=fps)
    stats = FeatureStats(np.zeros(363, np.float32), np.ones(363, np.float32), layout)
    given = {"stats": stats, "text": SimpleNamespace(encoder=FixedEncoder())}
    small = {"width": 8, "depth": 1, "code_dim": 8, "num_codes": 8}
    tokenizer = H2VQConfig(**small).build(layout).freeze()
    gpt = opinionated(InterleavedGPT(config, tokenizer.streams, tokenizer.pattern, 8))

    def of(levels: Any, net: InterleavedGPT, face: bool) -> GptGenerator:
        trained = {"tokenizer": TrainedTokenizer(levels, given), "text": given["text"]}
        return GptGenerator(LoadedGpt(net, "sentence"), trained, face)

    made: list[Any] = [of(tokenizer, gpt, False)]
    if "gpt" in faces:
        levels = RvqConfig(part="face", **small).build(layout).freeze()
        net = opinionated(InterleavedGPT(face or GPT, levels.streams, levels.pattern, 8))
        made.append(of(levels, net, True))
    if "diffusion" in faces:
        denoiser = Mdm(face or DENOISER, 50, 8)
        made.append(DiffusionMotion(layout, "face", given, denoiser.eval().requires_grad_(False)))
    if "vae" in faces:
        made.append(VaeMotion(layout, "face", given, SimpleNamespace()))  # type: ignore[arg-type]
    model = object.__new__(MotionModel)
    model.bundle = Bundle([stage(f"stage{k}", one) for k, one in enumerate(made)], StageCache())
    return model


def stage(name: str, made: Any, **given: Any) -> CompletedStage:
    """A finished stage that gives `made`, and those that feed it."""
    above = {role: stage(role, SimpleNamespace(encoder=one)) for role, one in given.items()}
    return CompletedStage(name, MadeStage(made), None, Path(name), above)


def test_a_length_for_each_caption() -> None:
    model = untrained()
    made = generate(model.bundle, Request.of(CAPTIONS, seconds=[0.4, 1.0, 0.2], seed=1), 2)
    assert [len(motion.joints) for motion in made] == [8, 20, 4]
    (note,) = model.notes(Request.of(CAPTIONS, seconds=[0.35, 1.0, 0.2]), made)
    assert isinstance(note, str) and note.startswith("0.35 s were asked for and 0.4 s")
    for row, motion in enumerate(model.generate(CAPTIONS, seconds=1.0, seed=1)):
        assert len(motion.joints) == 20
        if row == 1:
            np.testing.assert_allclose(motion.features, made[1].features, atol=1e-5)
    with pytest.raises(UserError, match="2 lengths"):
        model.generate(CAPTIONS, seconds=[1.0, 1.0])


@pytest.mark.parametrize(("fps", "least"), [(20.0, "0.2"), (30.0, "0.13")])
def test_lengths_out_of_reach_are_refused_with_the_true_range(fps: float, least: str) -> None:
    model = untrained(fps=fps)
    for seconds in (99.0, -1.0, float("nan"), float("inf"), [1.0, 1.0, 99.0]):
        with pytest.raises(UserError, match=f"this model makes {least} to {model.max_seconds:.1f} s"):
            model.generate(CAPTIONS, seconds=seconds)
    assert len(model.generate(CAPTIONS[:1], seconds=float(least))[0].joints) == 4


def test_body_and_face_are_those_of_each_motion_alone() -> None:
    model, before = untrained(faces=("gpt",)), torch.get_rng_state()
    first, *_ = model.generate(CAPTIONS, seconds=1.0, seed=3)
    (alone,) = model.generate(CAPTIONS[:1], seconds=1.0, seed=3)
    np.testing.assert_allclose(alone.features, first.features, atol=1e-5)
    np.testing.assert_allclose(alone.face, first.face, atol=1e-5)
    assert torch.equal(torch.get_rng_state(), before)


def test_temperature_zero_is_greedy() -> None:
    model, greedy = untrained(faces=("gpt",)), SamplingConfig(temperature=0)
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
    model = untrained(faces=(kind,))

    def made(**options: float) -> Any:
        sampling = SamplingConfig(denoising_steps=4, **options)
        return generate(model.bundle, Request.of(CAPTIONS[:1], seconds=1.0, seed=3, sampling=sampling))[0]

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
    model = untrained(faces=(kind,), face=config.model_copy(update={"condition_dropout": 0.0}))
    with pytest.raises(UserError, match=r"condition_dropout > 0.*face_cfg_scale"):
        model.generate(CAPTIONS, seconds=1.0, sampling=SamplingConfig(cfg_scale=2.0))
    fine = SamplingConfig(cfg_scale=2.0, face_cfg_scale=1.0, denoising_steps=2)
    assert len(generate(model.bundle, Request.of(CAPTIONS, seconds=1.0, sampling=fine))) == 3


@pytest.mark.parametrize("sampler", ["ddpm", "ddim", "dpm++"])
def test_more_steps_than_were_trained_are_refused(sampler: Any) -> None:
    model = untrained(faces=("diffusion",))
    asked = SamplingConfig(sampler=sampler, denoising_steps=2000)
    with pytest.raises(UserError, match="2000 denoising steps"):
        model.generate(CAPTIONS[:1], seconds=0.2, sampling=asked)
    once = SamplingConfig(sampler=sampler, denoising_steps=1)
    face = model.generate(CAPTIONS[:1], seconds=0.2, sampling=once)[0].face
    assert face is not None and np.isfinite(face).all()


WRONG_ASKS: dict[str, tuple[tuple[str, ...], dict[str, Any], str]] = {
    "one text": ((), {"captions": "wave"}, r"captions is one text; give a list, also of one: .*\['wave'\]"),
    "one face text": ((), {"face": "abc"}, r"face is one text; .*\['abc'\]"),
    "no text": ((), {"captions": ["a", 3, "b"]}, r"captions\[1\] = 3: not a text"),
    "empty": ((), {"captions": ["a", " ", "b"]}, r"captions\[1\] is empty"),
    "nothing": ((), {"captions": None}, "nothing to generate from: give captions, sounds or both"),
    "negative seed": ((), {"seed": -1}, "seed -1: a seed is a whole number"),
    "broken seed": ((), {"seed": 0.5}, "seed 0.5: a seed is a whole number"),
    "misspelt sampling": ((), {"sampling": {"topp": 0.9}}, "unknown key 'topp'; did you mean 'top_p'"),
    "no sampling": ((), {"sampling": 3}, "sampling: "),
    "face of no face": ((), {"face": CAPTIONS}, "this model makes no face"),
    "guidance of no face": ((), {"sampling": {"face_cfg_scale": 3.0}}, "face_cfg_scale: no generator"),
    "guidance of music": ((), {"sampling": {"guidance": {"audio": 2.0}}}, "guidance: no generator"),
    "steps of no face": ((), {"sampling": {"denoising_steps": 9}}, "denoising_steps: no generator"),
    "sampler of a GPT": (("gpt",), {"sampling": {"sampler": "ddim"}}, "sampler: no generator"),
    "guidance of a VAE": (("vae",), {"sampling": {"face_cfg_scale": 2.0}}, "face_cfg_scale: no generator"),
    "guidance of a VAE beside a GPT": (
        ("vae", "gpt"), {"sampling": {"face_cfg_scale": 2.0, "face_model": "vae"}}, "face_model to gpt"
    ),
    "steps beside a diffusion model": (
        ("gpt", "diffusion"), {"sampling": {"denoising_steps": 9}}, "set face_model to diffusion"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG_ASKS)
def test_what_has_no_sense_or_no_effect_is_refused(name: str) -> None:
    faces, given, says = WRONG_ASKS[name]
    asked = {"captions": CAPTIONS, "seconds": 0.2, **given}
    with pytest.raises(UserError, match=says):
        asked["sampling"] = SamplingConfig.of(given.get("sampling"))
        untrained(faces=faces).generate(**asked)


def test_a_face_is_chosen_by_its_method_or_its_stage() -> None:
    bundle = untrained(faces=("gpt", "diffusion")).bundle
    assert bundle.choose_face(None) is bundle.choose_face("gpt") is bundle.choose_face("stage1")
    assert bundle.choose_face("diffusion") is bundle.choose_face("stage2") is bundle.stages[2]
    with pytest.raises(UserError, match=r"'vae' here; .*gpt, diffusion"):
        bundle.choose_face("vae")


def test_the_commands_settings_reach_the_sampling(
    call: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: dict[str, Any] = {}
    watching = SimpleNamespace(
        make=lambda request: seen.update(sampling=request.sampling) or [],
        notes=lambda *_: [],
        bundle=SimpleNamespace(generator=SimpleNamespace(capabilities=Capabilities()), terms=Terms()),
    )
    monkeypatch.setattr("motionloom.pipeline.inference.model.MotionModel", lambda *_: watching)
    asked = {"sampler": "dpm++", "denoising_steps": 7, "cfg_scale": 3.0, "temperature": 0.0}
    words = [word for name, value in asked.items() for word in ("--set", f"{name}={value}")]
    words += ["--set", "guidance.audio=1.2"]
    assert call("generate", tmp_path, "a person walks", *words, "-o", tmp_path, "-f", "npz").code == 0
    assert seen["sampling"].model_dump(exclude_unset=True) == {**asked, "guidance": {"audio": 1.2}}
    for wrong in ("sampler=euler", "smapler=ddim", "top_p"):
        made = call("generate", "somewhere", "a person walks", "--set", wrong)
        assert made.code == 2 and wrong.partition("=")[0] in made.err


def test_the_stages_own_sampler_runs_unless_another_is_set() -> None:
    recipe = load_recipe("ude-tiny", ["ude.denoising_steps=7"], strict=False)
    stages = {one.name: one.config for one in recipe.stages}
    halves: list[Any] = [SimpleNamespace(modalities={"audio"}, given={}), SimpleNamespace()]
    engine = UdeGenerator(*halves, stages["ude"])
    assert engine.denoising(stages["report"].sampling) == ("dpm++", 7)
    assert engine.denoising(SamplingConfig(temperature=0.5, sampler="ddim")) == ("ddim", 7)


def test_a_protocol_names_the_settings_that_were_in_effect() -> None:
    model = untrained(faces=("gpt", "diffusion"))
    model.bundle.recommended = SamplingConfig(top_p=0.8, cfg_scale=2.0)
    tokens = {"temperature": 0.5, "top_k": 0, "top_p": 0.8, "cfg_scale": 2.0}
    assert model.bundle.in_effect(SamplingConfig(temperature=0.5)) == tokens
    assert model.bundle.in_effect(SamplingConfig(temperature=0.5, face_model="diffusion")) == {
        **tokens, "face_sampler": "ddpm", "face_denoising_steps": 50,
    }  # fmt: skip


def test_a_single_draw_is_the_first_of_several() -> None:
    assert candidate_seeds([5, 9], 1) == [5, 9]
    few, more = candidate_seeds([5], 2), candidate_seeds([5, 9], 4)
    assert more[0] == 5 and more[4] == 9 and more[:2] == few
    assert len(set(more)) == 8, "no draw is that of another text or of another place"
    assert repeated("ab", 2) == ["a", "a", "b", "b"]


@pytest.fixture(scope="module")
def model() -> MotionModel:
    """The model of the package, whose GPT's prior is TMA's."""
    if "synthetic" not in shipped_models():
        pytest.skip("this tree has no weights in models/pretrained/synthetic")
    return MotionModel.from_pretrained("synthetic", device="cpu")


def test_kept_is_the_single_draw_of_the_greatest_cosine(model: MotionModel) -> None:
    """Not the one of the greatest product; whatever the batch is, and at asked lengths too."""
    bundle, count = model.bundle, 3
    generator: Any = bundle.generator
    tma = generator.reranker
    columns = tma.layout.part("bodyhand")

    def cosine(caption: Tensor, motion: np.ndarray) -> float:
        cut = torch.from_numpy(tma.stats.normalize(motion, columns))[None, : tma.max_frames]
        with torch.no_grad():
            latent = tma.embed_motion(cut, torch.tensor([cut.shape[1]]))
        return float(torch.cosine_similarity(caption[None], latent))

    prompts = [Prompt(f"a person {does}") for does in ("kicks with the left leg", "claps twice", "squats")]

    def conditions_of(rows: list[int]) -> Any:
        some = [prompts[row] for row in rows]
        return encode(bundle, bundle.main, some, [prompt.text for prompt in some])

    def made(rows: list[int], frames: int | None, seeds: list[int], candidates: int) -> list[Any]:
        lengths = None if frames is None else [frames] * len(rows)
        sampling = SamplingConfig(top_p=0.8, candidates=candidates)
        return generator.generate(GenerationRequest(conditions_of(rows), lengths, seeds, sampling))

    for frames in (None, 38):
        chosen = made([0, 1, 2], frames, [5, 6, 7], count)
        drawn = made(repeated([0, 1, 2], count), frames, candidate_seeds([5, 6, 7], count), 1)
        for row, motion in enumerate(chosen):
            draws = drawn[count * row : count * (row + 1)]
            (text,) = generator.prior(GenerationRequest(conditions_of([row]), None, [0]))
            assert same(motion, max(draws, key=lambda draw: cosine(text, draw)))
            (alone,) = made([row], frames, [5 + row], count)
            assert same(motion, alone)


def same(one: np.ndarray, other: np.ndarray) -> bool:
    """Batched products round in their own way."""
    return one.shape == other.shape and np.allclose(one, other, atol=1e-4)


def test_a_model_without_such_a_tma_refuses(model: MotionModel, tmp_path: Path) -> None:
    sampling = SamplingConfig(candidates=2)
    model.bundle.require_used(sampling)
    faces = next(iter(model.bundle.faces.values()))
    assert "candidates" not in model.bundle.generator_of(faces).settings, "TMA reads no faces"
    sentence = replace(model.bundle.generator, gpt=replace(model.bundle.generator.gpt, prior="sentence"))  # type: ignore[type-var,attr-defined]
    assert "candidates" not in sentence.settings


def test_an_evaluation_does_not_let_its_judge_choose() -> None:
    with pytest.raises(UserError, match="leave candidates at 1"):
        EvaluateConfig.parse({"sampling": {"candidates": 4}}, "evaluate")
