"""TM2T's stages on a small run: trained, killed, exported and asked."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import HANDS, PRESENT_ALL
from motionloom.datasets.motion.body.rigid import fit_rigid
from motionloom.datasets.motion.bvh.motion import write_bvh
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.pipeline.curation.captioning import CaptionedClip, captions
from motionloom.pipeline.evaluation.figures import COMMON_CAPTION, MODEL, NEAREST, OWN_CAPTION, FigureFile
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.generation import generate
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.request import Request
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.dry_run import estimate
from motionloom.pipeline.runs.plan import Selection
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.store.training_log import read_training_log

RECIPE = """
extends: small
name: small
stages:
  captioner:
    kind: captioner
    net: {layers: 1, dim: 16, heads: 2, ff: 32, attention_dropout: 0.0, max_words: 12}
    least_uses: 1
    train: {steps: 6, batch_size: 8, checkpoint_every: 2, validate_every: 2}
  evaluate_captions: {kind: evaluate_captions, clips: 6, size: 4}
  seq2seq:
    kind: seq2seq
    net: {reader: 8, dim: 8, max_tokens: 50}
    train: {steps: 6, batch_size: 8, checkpoint_every: 2, validate_every: 2}
"""


@pytest.fixture(scope="module")
def recipe(small_run: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tm2t")
    shutil.copy(small_run.recipe, folder / "small.yaml")
    (folder / "tm2t.yaml").write_text(RECIPE)
    return folder / "tm2t.yaml"


@pytest.fixture(scope="module")
def finished(small_run: Any, recipe: Path) -> Path:
    """A copy of the small run with the captioner, not to be changed."""
    run = recipe.parent / "run"
    shutil.copytree(small_run.folder, run)
    run_recipe(recipe, run, select=Selection(until="captioner"), console=Console(quiet=True))
    return run


@pytest.fixture
def trained(finished: Path, tmp_path: Path) -> Path:
    """A copy of that."""
    shutil.copytree(finished, tmp_path / "run")
    return tmp_path / "run"


def test_a_captioner_is_trained_killed_exported_and_asked(
    trained: Path, recipe: Path, tmp_path: Path, call: Callable[..., Any]
) -> None:
    folder = trained / "stages/captioner"
    whole = (folder / "artifact.json").read_bytes()
    for name in ("artifact.json", "model.json", "model.safetensors", "checkpoints/step=00000006.ckpt"):
        (folder / name).unlink()
    done = call("run", recipe, "--out", trained, "--until", "captioner")
    assert done.code == 0 and "captioner at step 4" in done.out
    assert (folder / "artifact.json").read_bytes() == whole

    words = json.loads((folder / "model.json").read_text())["extra"]["words"]
    dataset = ShardDataset.open(trained / "stages/data/shards", "test")
    assert {"a", "left"} <= set(words)
    call("export", trained, "--out", tmp_path / "model")
    asked = []
    for place in (trained, tmp_path / "model"):
        captioner = Bundle.open(place).captioner
        motions = [dataset.motion(clip)[:, captioner.layout.part(captioner.part)] for clip in (0, 1)]
        asked.append(captioner.caption(motions, 3))
        handless = captioner.caption(motions, 3, [PRESENT_ALL & ~HANDS] * 2)
        assert [len(one) for one in handless] == [3, 3]
        alone = captioner.caption(motions[1:], 3)[0]
        assert [one.text for one in alone] == [one.text for one in asked[-1][1]]
        for one, other in zip(alone, asked[-1][1], strict=True):
            assert one.log_probability == pytest.approx(other.log_probability, abs=1e-4)
    assert asked[0] == asked[1]
    for sentences in asked[0]:
        likely = [one.probability for one in sentences]
        assert likely == sorted(likely, reverse=True) and 0 < sum(likely) <= 1
        assert len({one.text for one in sentences}) == 3
        assert all(set(one.text.split()) <= set(words) and one.text for one in sentences)


def test_captions_are_measured_beside_those_that_need_no_model(
    trained: Path, recipe: Path, call: Callable[..., Any]
) -> None:
    """What true captions claim holds; a clip's own other caption shares more words than the most frequent."""
    done = call("run", recipe, "--out", trained, "--until", "evaluate_captions")
    assert done.code == 0, done.err
    found = FigureFile.read(trained / "stages/evaluate_captions/metrics.json")
    rows = {figure.row for figure in found.figures}
    assert rows == {MODEL, NEAREST, COMMON_CAPTION, OWN_CAPTION}
    for row in rows:
        values = {one.name: one.value for one in found.figures if one.row == row}
        assert all(0 <= value <= (10 if name == "captions.cider-d" else 1) for name, value in values.items())
        assert {f"captions.{n}" for n in ("bleu-4", "rouge-l", "bert", "R-precision-3")} <= values.keys()
    assert found.figures[0].protocol["clips"] == 6 and found.figures[0].protocol["size"] == 4

    def value(name: str, row: str) -> float:
        figure = found.of(f"captions.{name}", row)
        assert figure is not None
        return figure.value

    assert value("claims_hold", OWN_CAPTION) == 1
    assert value("bleu-1", OWN_CAPTION) > value("bleu-1", COMMON_CAPTION)
    assert value("bert", OWN_CAPTION) > value("bert", COMMON_CAPTION)


def test_text_to_motion_is_trained_exported_and_asked(
    trained: Path, recipe: Path, tmp_path: Path, call: Callable[..., Any]
) -> None:
    """Beside the GPT of the run, as a stage that a recipe lists."""
    folder = trained / "stages/seq2seq"
    assert call("run", recipe, "--out", trained, "--until", "seq2seq").code == 0
    logged = [row for row in read_training_log(folder) if "val/inverse" in row]
    assert [row["step"] for row in logged] == [2, 4, 6]

    for stage in ("gpt", "face_gpt", "face_vae", "face_diffusion", "generate", "evaluate", "report"):
        shutil.rmtree(trained / "stages" / stage)
    call("export", trained, "--out", tmp_path / "model")
    made = [
        generate(
            Bundle.open(place), Request.of(["a person waves", "a person walks"], seconds=seconds, seed=3)
        )
        for place in (trained, tmp_path / "model")
        for seconds in (None, 1.5)
    ]
    for one, other in zip(made[:2], made[2:], strict=True):
        for motion, again in zip(one, other, strict=True):
            np.testing.assert_array_equal(motion.features, again.features)
    assert [len(motion.features) for motion in made[1]] == [32, 32]  # 1.5 seconds, in whole groups
    assert all(4 <= len(motion.features) <= 4 * 16 for motion in made[0])


def test_a_captioner_of_other_tokens_cannot_align(recipe: Path) -> None:
    with pytest.raises(UserError, match=r"captioner .* 15 .* 16; "):
        estimate(load_recipe(recipe, ["captioner.net.block_size=50", "seq2seq.net.max_tokens=50"]))
    with pytest.raises(UserError, match="captioner stage"):
        estimate(load_recipe(recipe, ["seq2seq.inputs.captioner=null"]))


def test_an_uncaptioned_folder_becomes_a_data_set(
    trained: Path, tmp_path: Path, call: Callable[..., Any]
) -> None:
    """BVH and npz in a folder of folders, with files that are none: captioned, and converted with that."""
    takes = tmp_path / "takes"
    (takes / "walks").mkdir(parents=True)
    for number, motion in enumerate(MotionModel(trained).generate(["a person walks"] * 3, seconds=2.0)):
        motion.save(takes / "walks" / f"w{number}.bvh")
    motion = replace(
        motion, joints=np.concatenate([motion.joints] * 6), face=None
    )  # longer than a captioner reads
    np.savez(takes / "last.npz", joints=motion.joints, metadata=json.dumps({"fps": motion.fps}))
    bare = fit_rigid(motion.joints[:, :22], Skeleton.named("smpl22"))
    write_bvh(takes / "walks" / "w3.bvh", bare.skeleton, bare.rotations, bare.root, 20)
    np.savez(takes / "short.npz", joints=motion.joints[:2], metadata=json.dumps({"fps": 30}))
    nan = np.where(np.arange(52)[:, None] == 3, np.nan, motion.joints)
    np.savez(takes / "nan.npz", joints=nan, metadata=json.dumps({"fps": 30}))
    np.savez(takes / "dog.npz", joints=motion.joints[:, :30], metadata=json.dumps({"fps": 30}))
    listed = tmp_path / "captions.jsonl"
    done = call("caption", trained, takes, "--k", 2, "-o", listed)
    assert done.code == 0, done.err
    for says in ("short.npz: 2 frames are no motion", "nan.npz: NaN or infinity", "dog.npz: joints of shape"):
        assert says in done.out
    rows = [json.loads(line) for line in listed.read_text().splitlines()]
    assert [row["id"] for row in rows] == [*(f"walks/w{k}" for k in range(4)), "last"]
    for row in rows:
        assert len(row["probabilities"]) == len(row["captions"]) and len(row["captions"]) % 2 == 0
        assert {one["source"] for one in row["captions"]} == {"captioner"}
    model = MotionModel(trained)
    again, made = captions(model, [takes / "last.npz", motion], count=2)
    assert isinstance(again, CaptionedClip) and isinstance(made, CaptionedClip)
    told = [(part.start, part.end, one.text) for part in again.parts for one in part.sentences]
    assert told == [(one["start"], one["end"], one["text"]) for one in rows[-1]["captions"]]
    assert made.seconds == again.seconds and len(made.parts[0].sentences) == 2
    longest = model.bundle.captioner.max_frames / model.fps
    assert made.seconds > longest, "read in parts, none longer than the captioner reads, over the whole clip"
    assert [part.start for part in made.parts] == [0.0, *(part.end for part in made.parts[:-1])]
    assert made.parts[-1].end == made.seconds
    assert max(part.end - part.start for part in made.parts) <= longest + 1e-3

    (takes / "last.npz").unlink()
    (takes / "walks" / "w3.bvh").unlink()
    listed.write_text("".join(f"{json.dumps(row)}\n" for row in rows[:3]))
    done = call(
        "data", "convert", "bvh", takes, tmp_path / "shards", "--captions", listed, "--licence", "own"
    )
    assert done.code == 0, done.err
    found = {
        ShardDataset.open(tmp_path / "shards", shard["split"]).texts(0)[0].source
        for shard in json.loads((tmp_path / "shards/manifest.json").read_text())["shards"]
    }
    assert found == {"captioner"}


def test_an_export_that_only_captions(trained: Path, tmp_path: Path, call: Callable[..., Any]) -> None:
    for stage in ("gpt", "face_gpt", "face_vae", "face_diffusion", "generate", "evaluate", "report"):
        shutil.rmtree(trained / "stages" / stage)
    call("export", trained, "--out", tmp_path / "model")
    bundle = Bundle.open(tmp_path / "model")
    assert bundle.stages == () and bundle.layout == bundle.captioner.layout
    folders = {path.name for path in (tmp_path / "model").iterdir() if path.is_dir()}
    assert folders == {"captioner", "tokenizer", "stats"}
    with pytest.raises(UserError, match=r"stage .*body motion"):
        generate(bundle, Request.of(["a person walks"]))


def test_a_model_without_one_says_so(small_run: Any) -> None:
    with pytest.raises(UserError, match=r"captions motion; .*kind captioner"):
        Bundle.open(small_run.folder).captioner  # noqa: B018
