"""Several draws for each text, of which TMA chooses: which is kept, what it gains, where it is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.datasets.synth.measure import agrees
from motionloom.pipeline.contract.fingerprint import fingerprint_fields
from motionloom.pipeline.contract.generation import GenerationRequest, Prompt
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.candidates import candidate_seeds, nearest_candidates, repeated
from motionloom.pipeline.inference.pretrained import MotionModel
from motionloom.pipeline.inference.requests import require_used
from motionloom.pipeline.inference.shipped_models import shipped_models
from motionloom.pipeline.stages.evaluate_units import EvaluateConfig

LAYOUT = MotionLayout.named("wholebody363", fps=20.0)
WIDTH = len(LAYOUT.part("bodyhand"))


class FirstColumns:
    """Embeds a motion as the mean of its first two columns."""

    layout, part, max_frames = LAYOUT, "bodyhand", 100
    stats = FeatureStats(np.zeros(363, np.float32), np.ones(363, np.float32), LAYOUT)

    def embed_motion(self, motion: Tensor, length: Tensor, present: Tensor | None = None) -> Tensor:
        return torch.stack([row[:n, :2].mean(0) for row, n in zip(motion, length.tolist(), strict=True)])


def still(a: float, b: float, frames: int = 4) -> np.ndarray:
    motion = np.zeros((frames, WIDTH), np.float32)
    motion[:, :2] = a, b
    return motion


def test_a_single_draw_is_the_first_of_several() -> None:
    assert candidate_seeds([5, 9], 1) == [5, 9]
    few, more = candidate_seeds([5], 2), candidate_seeds([5, 9], 4)
    assert more[0] == 5 and more[4] == 9 and more[:2] == few
    assert len(set(more)) == 8, "no draw is that of another text or of another place"
    assert repeated("ab", 2) == ["a", "a", "b", "b"]


def test_the_draw_of_the_greatest_cosine_is_kept() -> None:
    """Not the one of the greatest product; draws of one text differ in length."""
    texts = torch.tensor([[0.0, 2.0], [1.0, 1.0]])
    drawn = [still(9, 9), still(0, 0.1, frames=8), still(1, 0), still(9, 0), still(0.2, 0.2), still(0, 9)]
    first, second = nearest_candidates(FirstColumns(), texts, drawn)
    assert first is drawn[1] and second is drawn[4]


@pytest.fixture(scope="module")
def model() -> MotionModel:
    """The model of the package, whose GPT's prior is TMA's."""
    if "synthetic" not in shipped_models():
        pytest.skip("this tree has no weights in models/pretrained/synthetic")
    return MotionModel.from_pretrained("synthetic", device="cpu")


def test_kept_is_one_of_the_single_draws(model: MotionModel) -> None:
    """Whatever the batch is, and at asked lengths too."""
    bundle, count = model.bundle, 3
    prompts = [Prompt(f"a person {does}") for does in ("kicks with the left leg", "claps twice", "squats")]
    texts = [prompt.text for prompt in prompts]

    def made(rows: list[int], frames: int | None, seeds: list[int], candidates: int) -> list[Any]:
        conditions = bundle.encoder(bundle.main).encode(
            [prompts[row] for row in rows], [texts[row] for row in rows], frozenset({"text"}), model.fps
        )
        lengths = None if frames is None else [frames] * len(rows)
        sampling = SamplingConfig(top_p=0.8, candidates=candidates)
        return bundle.generator.generate(GenerationRequest(conditions, lengths, seeds, sampling))

    for frames in (None, 38):
        chosen = made([0, 1, 2], frames, [5, 6, 7], count)
        drawn = made(repeated([0, 1, 2], count), frames, candidate_seeds([5, 6, 7], count), 1)
        for row, motion in enumerate(chosen):
            draws = drawn[count * row : count * (row + 1)]
            assert any(same(motion, draw) for draw in draws)
            (alone,) = made([row], frames, [5 + row], count)
            assert same(motion, alone)


def same(one: np.ndarray, other: np.ndarray) -> bool:
    """Batched products round in their own way."""
    return one.shape == other.shape and np.allclose(one, other, atol=1e-4)


def test_chosen_motions_do_more_often_what_is_said(model: MotionModel) -> None:
    """Judged by geometry, which TMA knows nothing of; what is counted most often goes wrong."""
    said = [
        (f"a person {verb} {times}", {"action": action, "count": count, **more})
        for verb, action, more in (
            ("squats", "squat", {}),
            ("claps", "clap", {}),
            ("punches with the left hand", "punch", {"side": "left"}),
            ("kicks with the right leg", "kick", {"side": "right"}),
        )
        for times, count in (("once", 1), ("twice", 2), ("three times", 3))
    ]
    right = {}
    for count in (1, 4):
        motions = model.generate([text for text, _ in said] * 4, seed=1, sampling={"candidates": count})
        found = [
            agrees(truth, motion.joints, None, model.fps)
            for motion, (_, truth) in zip(motions, said * 4, strict=True)
        ]
        right[count] = np.mean([all(one.values()) for one in found])
    assert right[4] >= right[1] + 0.05


def test_a_model_without_such_a_tma_refuses(model: MotionModel, tmp_path: Path) -> None:
    sampling = SamplingConfig(candidates=2)
    require_used(model.bundle, None, sampling)
    faces = next(iter(model.bundle.faces.values()))
    assert "candidates" not in model.bundle.of(faces).settings, "TMA reads no faces"
    sentence = replace(model.bundle.generator, gpt=replace(model.bundle.generator.gpt, prior="sentence"))  # type: ignore[type-var,attr-defined]
    assert "candidates" not in sentence.settings
    with pytest.raises(UserError, match=r"a stream shows its motion as it is drawn.*--candidates"):
        model.stream("a person walks", seconds=1.0, sampling={"candidates": 2})
    next(model.stream("a person walks", seconds=1.0))  # what the model recommends holds where it can


def test_an_evaluation_does_not_let_its_judge_choose() -> None:
    with pytest.raises(UserError, match="TMA would choose the motions that it then judges"):
        EvaluateConfig.parse({"sampling": {"candidates": 4}}, "evaluate")


def test_finished_stages_stay_finished() -> None:
    """The field is newer than runs; at its default it is no part of their fingerprint."""
    assert "candidates" not in fingerprint_fields(SamplingConfig())
    assert fingerprint_fields(SamplingConfig(candidates=4))["candidates"] == 4


def test_an_export_recommends_it(call: Any, tmp_path: Path, model: MotionModel) -> None:
    said = json.loads((shipped_models()["synthetic"].folder / "bundle.json").read_text())["sampling"]
    assert said["candidates"] == model.bundle.drawing().candidates == 4
    assert model.bundle.drawing({"candidates": 1}).candidates == 1
    made = call("generate", "synthetic", "a person walks", "--candidates", "0")
    assert made.code != 0 and "candidates" in made.err
