"""What an evaluation prints is what its names say: joint errors, matching score, whose words TMA reads."""

from __future__ import annotations

import hashlib
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console
from text_samples import tiny_clip, tiny_distilbert

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.motion.layout import FINGERS, WRISTS, MotionLayout
from motionloom.models.metrics import retrieval
from motionloom.models.metrics.distributions import fid
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.diagnosis import joint_distances
from motionloom.pipeline.evaluation.figures import CHANCE, MODEL, RECORDED, STILL, TRAINING, FigureFile
from motionloom.pipeline.evaluation.judges import Judge
from motionloom.pipeline.evaluation.latent_metrics import Latents, judged_figures
from motionloom.pipeline.evaluation.reconstruction import expression_directions, published_errors
from motionloom.pipeline.evaluation.retrieval import retrieve
from motionloom.pipeline.evaluation.truth import drawn, reconstruct_all, spread_any, truth_of
from motionloom.pipeline.results.paper.compare import compare_with_paper
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.plan import Selection
from motionloom.pipeline.stages.networks.evaluator import EvaluatorStage
from motionloom.pipeline.store.evaluator import LoadedEvaluator, StageWords, embed_motions
from motionloom.pipeline.store.weights import load_facts

RECIPE = """
extends: t2m-gpt-tiny
name: two-encoders
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
stages:
  data:
    {clips: 90, min_seconds: 2.0, max_seconds: 5.0, test_fraction: 0.5, actions: [raise], hand_shapes: [fist]}
  text: {encoder: DISTILBERT}
  words: {kind: text, encoder: CLIP}
  tma: {inputs: {text: words}, net: {latent: 8, ff: 16, layers: 1}, train: {steps: 2, batch_size: 4}}
  tokenizer: {net: {width: 8, depth: 1, code_dim: 8, num_codes: 8}, train: {steps: 2, batch_size: 4}}
  gpt: {net: {layers: 1, dim: 16, heads: 2, ff: 16}, train: {steps: 2, batch_size: 4}}
  face_tokenizer: null
  face_tokens: null
  face_gpt: null
  generate: null
  report: null
  evaluate: {repeats: 1, size: 4}
"""


@pytest.mark.slow
def test_tma_reads_captions_by_its_own_encoder(tmp_path: Path) -> None:
    """The GPT's prior is one encoder's, the judge another's of the same width (Table 8, first row)."""
    for kind in ("distilbert", "clip"):
        (tmp_path / kind).mkdir()
    encoders = tiny_distilbert(tmp_path / "distilbert"), tiny_clip(tmp_path / "clip")
    recipe = RECIPE.replace("DISTILBERT", str(encoders[0])).replace("CLIP", str(encoders[1]))
    (tmp_path / "recipe.yaml").write_text(recipe)
    run_recipe(tmp_path / "recipe.yaml", tmp_path / "run", console=Console(quiet=True))
    file = FigureFile.read(tmp_path / "run/stages/evaluate/metrics.json")
    stages, stage_cache = finished_stages(tmp_path / "run"), StageCache()
    dataset, tma = stage_cache.get(stages["data"]).split("test"), stage_cache.get(stages["tma"])
    truths = [truth_of(dataset, i) for i in sorted(drawn(dataset, 400))]
    assert len(truths) == len(dataset)
    motion = embed_motions(tma, [t.features for t in truths]).double()
    distance = {}
    for name in ("words", "text"):
        latent = tma.embed_captions([t.caption for t in truths], stage_cache.get(stages[name]).cache).double()
        units = [x / x.norm(dim=-1, keepdim=True) for x in (latent, motion)]
        distance[name] = (units[0] - units[1]).norm(dim=-1).mean().item()
        plain = (latent - motion).norm(dim=-1).mean().item()
        if name == "words":
            for key, wanted in (("matching_score", distance["words"]), ("latent_distance", plain)):
                found = file.of(f"tma.{key}", RECORDED)
                assert found is not None and found.value == pytest.approx(wanted, rel=1e-5)
    assert abs(distance["words"] - distance["text"]) > 1e-4, "ten times what the comparison above allows"
    made, apart = file.of("tma.t2m_r1"), file.of("tma.different.t2m_r1")
    assert made is not None and apart is not None
    weights = (tmp_path / "run/stages/tma/model.safetensors").read_bytes()
    assert made.protocol["judge"] == hashlib.sha256(weights).hexdigest()
    assert file.about["judges"]["tma"]["stage"] == "tma" and file.about["made_by"] == {"generator": "gpt"}
    assert (made.protocol["repeats"], made.protocol["lengths"]) == (1, "free")
    several = len({t.caption for t in truths})
    assert several < len(truths), "captions occur twice, as they do in the papers' splits"
    assert (made.protocol["clips"], apart.protocol["clips"]) == (len(truths), several)
    other, still = file.of("tma.fid", TRAINING), file.of("tma.fid", STILL)
    spread = file.of("tma.diversity", RECORDED)
    assert other is not None and still is not None and spread is not None and spread.value > 0
    assert 0 < other.value < still.value, "other recorded clips are nearer than a statue"
    assert file.of("tma.fid", RECORDED) is None
    assert file.of("tma.multimodality") is None, "one motion a caption has no variety"


def test_errors_of_body_and_hands_by_hand() -> None:
    """Root of each frame at the origin for all and the body, each hand's wrist for its fingers."""
    generator = np.random.default_rng(0)
    real, made = generator.normal(size=(2, 7, 52, 3))
    found = published_errors(torch.from_numpy(made), torch.from_numpy(real))
    each = []
    want: dict[str, list[float]] = {"": [], "_body": [], "_hand": []}
    for a, b in zip(made, real, strict=True):
        distance = [float(np.linalg.norm((a[j] - a[0]) - (b[j] - b[0]))) for j in range(52)]
        want[""].append(1000 * sum(distance) / 52)
        want["_body"].append(1000 * sum(distance[:22]) / 22)
        fingers = [
            float(np.linalg.norm((a[j] - a[wrist]) - (b[j] - b[wrist])))
            for wrist, hand in zip(WRISTS, FINGERS, strict=True)
            for j in hand
        ]
        want["_hand"].append(1000 * sum(fingers) / 30)
        each.append([*distance[:22], *fingers])
    assert joint_distances(made, real).tolist() == pytest.approx((1000 * np.mean(each, axis=0)).tolist())
    body_alone = joint_distances(made[:, :22], real[:, :22])
    assert body_alone.tolist() == pytest.approx((1000 * np.mean(each, axis=0)[:22]).tolist())
    for part, values in want.items():
        assert found[part].means()["mpjpe"] == pytest.approx(np.mean(values), rel=1e-12)
    second = made - real
    jerk = np.linalg.norm(second[2:] - 2 * second[1:-1] + second[:-2], axis=-1)
    assert found[""].means()["accel"] == pytest.approx(1000 * jerk.mean(), rel=1e-12)
    assert found["_hand"].means()["accel"] == pytest.approx(1000 * jerk[:, 22:].mean(), rel=1e-12)
    body = published_errors(torch.from_numpy(made[:, :22]), torch.from_numpy(real[:, :22]))
    assert set(body) == {"", "_body"}


def test_distributions_over_repeats() -> None:
    """FID (which has goldens of its own) is a mean over repeats; Diversity and MModality pair by pair."""
    generator = torch.Generator().manual_seed(0)
    real, others = torch.randn(2, 400, 6, generator=generator)
    shift = torch.linspace(0.5, 2, 6)
    made = [shift * torch.randn(400, 6, generator=generator) + 1 for _ in range(3)]
    latents = Latents(text=real, real=real, made=made, others=others, still=torch.ones(400, 6))
    words = [str(row) for row in range(400)]
    figures = judged_figures("evaluator", "it", latents, words, {}, size=32, among=2, seed=0)
    found = {one.name.removeprefix("evaluator."): one.value for one in figures if one.row == MODEL}
    assert found["fid"] == pytest.approx(np.mean([float(fid(real, m)) for m in made]))
    pairs = [[x.double() / x.double().norm(dim=-1, keepdim=True) for x in (real, m)] for m in made]
    assert found["fid_unit"] == pytest.approx(np.mean([float(fid(*pair)) for pair in pairs]))
    (other,) = (one.value for one in figures if (one.name, one.row) == ("evaluator.fid", TRAINING))
    assert other == pytest.approx(float(fid(real, others))) and other < 0.1 < 5 < found["fid"]
    # Two draws of one Gaussian are sqrt(2) as far apart as it is wide: 300 pairs, five deviations.
    assert found["diversity"] == pytest.approx(float((2 * shift.square().sum()).sqrt()), rel=0.15)
    apart = [float((made[a] - made[b]).norm(dim=-1).mean()) for a, b in ((0, 1), (0, 2), (1, 2))]
    assert 0 < found["multimodality"] <= max(apart)


@pytest.mark.parametrize("size", [32, 256])
def test_matching_is_that_of_the_public_code(
    size: int, shared: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The golden batches are in row order, so the draw of batches is taken out."""
    monkeypatch.setattr(retrieval.torch, "randperm", lambda count, **_: torch.arange(count))  # type: ignore[attr-defined]
    with np.load(shared / "golden" / "t6_metrics_A.npz", allow_pickle=False) as data:
        golden = {key: torch.from_numpy(np.asarray(data[key])) for key in data.files}
    text, real, made = (golden[name] for name in ("text", "gt", "pred"))
    still = real.mean(0).expand_as(real)
    latents = Latents(text=text, real=real, made=[made], others=made[:300], still=still)
    words = [str(row) for row in range(len(text))]
    figures = judged_figures("evaluator", "it", latents, words, {}, size=size, among=2, seed=0)
    found = {(one.row, one.name.removeprefix("evaluator.")): one.value for one in figures}
    for name, row in (("pred", MODEL), ("gt", RECORDED)):
        tops = [found[row, f"top-{k}"] for k in (1, 2, 3)]
        assert tops == pytest.approx(golden[f"rprec_{name}_B{size}"].tolist(), rel=1e-5)
        assert found[row, "matching_score"] == pytest.approx(golden[f"match_{name}_B{size}"].item(), rel=1e-5)
    assert [found[CHANCE, f"top-{k}"] for k in (1, 2, 3)] == [k / size for k in (1, 2, 3)]
    # Motions that are all alike share all places, so none is among the first.
    assert found[STILL, "top-1"] == 0 and found[STILL, "matching_score"] > 0
    assert found[MODEL, "fid"] == pytest.approx(golden["fid_pred_gt_float64"].item(), rel=1e-5)
    rows = {row for row, name in found if name == "fid"}
    assert rows == {MODEL, TRAINING, STILL}, "recorded motion has no distance to itself"


# The trained evaluator: it judges, and refuses.

OWN = """
name: judge
seed: 1
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
stages:
  data:
    {kind: synth, clips: 300, layout: body133, min_seconds: 2.0, max_seconds: 5.0, test_fraction: 0.2,
     actions: [walk, turn, squat, kick, raise]}
  stats: {kind: stats}
  text: {kind: text}
  evaluator:
    kind: evaluator
    net: {movement_hidden: 64, movement: 64, motion_hidden: 64, text_hidden: 64, latent: 32}
    movement_steps: 2
    train: {steps: 4, batch_size: 32, checkpoint_every: 60, validate_every: 0}
  temos:
    {kind: tma, net: {latent: 8, ff: 16, layers: 1, heads: 2}, loss: {contrastive: 0.0},
     train: {steps: 2, batch_size: 4, validate_every: 0}}
  evaluate:
    {kind: evaluate, clips: 24, repeats: 3, size: 8, lengths: recorded,
     inputs: {tma: null, generators: [temos]}}
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The finished run."""
    root = tmp_path_factory.mktemp("judge")
    (root / "judge.yaml").write_text(OWN)
    return run_recipe(root / "judge.yaml", root / "run", console=Console(quiet=True))


def loaded(run: Path) -> tuple[Any, LoadedEvaluator]:
    """Data and evaluator of a run."""
    stages, stage_cache = finished_stages(run), StageCache()
    return stage_cache.get(stages["data"]), stage_cache.get(stages["evaluator"])


@pytest.mark.slow
def test_an_evaluation_is_judged_by_it(run: Path) -> None:
    file = FigureFile.read(run / "stages/evaluate/metrics.json")
    weights = sha256_of(run / "stages/evaluator/model.safetensors")
    assert file.about["judges"] == {
        "evaluator": {"stage": "evaluator", "kind": "evaluator", "sha256": weights}
    }
    assert not any(one.name.startswith("tma.") for one in file.figures), "no TMA, no figures by it"
    top = file.of("evaluator.top-1")
    data, evaluator = loaded(run)
    assert top is not None and top.protocol["judge"] == weights
    assert (top.protocol["clips"], top.protocol["candidates"]) == (24, 8)
    others, still, made = (file.of("evaluator.fid", row) for row in (TRAINING, STILL, MODEL))
    assert others is not None and still is not None and made is not None
    assert 0 < others.value < still.value and made.value > 0 and data.layout == evaluator.layout
    retrieved = retrieve(run, "evaluator")
    truths = [t for t in (truth_of(data.split("test"), i) for i in range(60)) if t.caption]
    judge_ = Judge(evaluator)
    text, motion = judge_.texts(truths), judge_.recorded(truths)
    closest = torch.cdist(text.double(), motion.double()).argmin(1) == torch.arange(len(truths))
    first = retrieved.of("A.t2m/R@1")
    assert first is not None and first.value == pytest.approx(closest.double().mean().item())
    assert retrieved.about["sha256"] == weights and retrieved.about["clips"] == len(truths) == 60


@pytest.mark.slow
def test_other_layouts_and_words_are_refused(run: Path) -> None:
    data, evaluator = loaded(run)
    evaluator.require_layout(data.layout, "evaluator")
    words = evaluator.words
    assert isinstance(words, StageWords)
    foreign = replace(evaluator, words=replace(words, encoder="other:123"))
    stats = replace(evaluator.stats, layout=MotionLayout.named("body133", fps=30))
    given = EvaluatorStage.inputs({"stats": lambda: stats, "text": lambda: words.text})
    facts = load_facts(run / "stages/evaluator")
    for refused, said in (
        (lambda: evaluator.require_layout(MotionLayout.named("wholebody313"), "judge"), "wholebody313"),
        (lambda: evaluator.require_layout(stats.layout, "judge"), "30 fps"),
        (lambda: evaluator.embed_captions(["nobody says"], [()]), "'nobody says'"),
        (lambda: foreign.embed_captions(["a person walks"], [()]), r"model\.json: .*other:123"),
        (lambda: EvaluatorStage().loaded(evaluator.net, facts, given), "statistics of body133"),
    ):
        with pytest.raises(UserError, match=said):
            refused()


# Faces judged by a TMA of faces, motion beside what was recorded for its caption.

FACES = """
extends: small
name: small
stages:
  face_evaluator:
    {kind: tma, part: face, net: {latent: 8, ff: 16, layers: 1, frame_stride: 1}, loss: {contrastive: 0.1},
     train: {steps: 4, batch_size: 8, checkpoint_every: 4, validate_every: 4}}
  evaluate: {clips: 9, repeats: 2, size: 4, face_model: HEAD}
  # As in the recipes of the baselines.
  evaluate_face_vae:
    {kind: evaluate, clips: 9, repeats: 1, size: 4,
     inputs: {tokenizer: null, face_tokenizer: null, tma: null, generators: [gpt, face_vae]}}
  evaluate_face_diffusion:
    {kind: evaluate, clips: 9, repeats: 1, size: 4,
     inputs: {tokenizer: null, face_tokenizer: null, tma: null, generators: [gpt, face_diffusion]}}
"""


@pytest.fixture(scope="module")
def judged(small_run: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with an evaluator of faces, evaluated by it."""
    root = tmp_path_factory.mktemp("faces")
    shutil.copy(small_run.recipe, root / small_run.recipe.name)
    # As SMPL-X's file: 300 directions of shape, 100 of expression; two of six vertices are of a face.
    shapes = np.random.default_rng(0).normal(size=(6, 3, 400)) * 0.01
    shapes[:4, :, 300:] = 0.0
    np.savez(root / "SMPLX.npz", shapedirs=shapes)
    (root / "faces.yaml").write_text(FACES.replace("HEAD", str(root / "SMPLX.npz")))
    shutil.copytree(small_run.folder, root / "run")
    wanted = "evaluate,evaluate_face_vae,evaluate_face_diffusion"
    run_recipe(root / "faces.yaml", root / "run", select=Selection(until=wanted), console=Console(quiet=True))
    return root


@pytest.mark.slow
def test_faces_have_a_judge(judged: Path) -> None:
    file = FigureFile.read(judged / "run/stages/evaluate/metrics.json")
    made = {one.name: one.value for one in file.figures if one.row == MODEL}
    tops = {f"face_evaluator.{name}" for name in ("top-1", "top-2", "top-3", "matching_score")}
    assert tops <= made.keys() and made["face_evaluator.fid"] > 0
    assert file.about["judges"]["face_evaluator"]["stage"] == "face_evaluator"
    others = file.of("reconstruction.face_evaluator.fid", TRAINING)
    assert others is not None and others.value > 0 and made["reconstruction.face_evaluator.fid"] > 0
    assert 0 <= made["reconstruction.face_evaluator.top-3"] <= 1
    top = file.of("face_evaluator.top-1")
    assert top is not None and (top.protocol["clips"], top.protocol["candidates"]) == (7, 4)
    # By hand: expressions, and the vertices that they move.
    with np.load(judged / "SMPLX.npz") as model:
        moves = model["shapedirs"][4:, :, 300:350]
    stages, stage_cache = finished_stages(judged / "run"), StageCache()
    data, tokenizer = stage_cache.get(stages["data"]).split("test"), stage_cache.get(stages["face_tokenizer"])
    errors, frames, vertices = 0.0, 0, 0.0
    for truth in (truth_of(data, index) for index in spread_any(data, 9)):
        if truth.face is not None:
            rebuilt = reconstruct_all(tokenizer, truth)[:, data.layout.slice("face")].astype(np.float64)
            errors += np.sqrt(np.square(rebuilt - truth.face).sum(-1)).sum()
            frames += len(rebuilt)
            for before, after in zip(truth.face, rebuilt, strict=True):
                places = [
                    [float(axis @ values) for axis in moves.reshape(6, 50)] for values in (before, after)
                ]
                off = np.reshape(np.subtract(*places), (2, 3))
                vertices += 1000 * np.linalg.norm(off, axis=1).mean()
    assert made["face.expression"] == pytest.approx(errors / frames, abs=2e-5)
    assert made["face.vertex"] == pytest.approx(vertices / frames, rel=1e-4)


def test_another_model_is_refused(tmp_path: Path) -> None:
    ones, path = np.ones((5, 3, 400)), tmp_path / "model.npz"
    wrong = {"300 shape": ones[..., :20], "all 0": 0 * ones, "NaN": np.nan * ones, r"\[5, 400\]": ones[:, 0]}
    for says, shapes in {**wrong, "pickle": np.array([{}])}.items():
        np.savez(path, shapedirs=shapes)
        with pytest.raises(UserError, match=rf"model\.npz.*{says}"):
            expression_directions(path)


@pytest.mark.slow
def test_each_facial_generator_has_a_row(judged: Path) -> None:
    (found,) = compare_with_paper("humantomato/4", [judged / "run"])
    ours = {row.method: row for row in found.rows if row.source == "ours"}
    assert set(ours) == {"cVAE", "Diffusion", "Ours"}
    for row in ours.values():
        assert all(cell is not None for cell in row.cells[:6]), row
    assert "– of fewer than 10 clips" in found.markdown()
    stages = judged / "run/stages"
    files = [
        FigureFile.read(stages / f"evaluate{of}/metrics.json") for of in ("", "_face_vae", "_face_diffusion")
    ]
    assert len({fid.value for file in files if (fid := file.of("face_evaluator.fid"))}) == 3
