"""One small recipe through every command, from no data to motions that tools and browsers open."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bvhio
import numpy as np
import pytest
import yaml
from safetensors.numpy import load_file, save_file

from motionloom.datasets.motion.bvh.motion import read_bvh
from motionloom.pipeline.evaluation.figures import MODEL, RECORDED, FigureFile
from motionloom.pipeline.inference.files.display_figure import shown
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.store.artifact import Artifact

pytestmark = pytest.mark.slow

STAGES = [
    *("data", "stats", "text", "tokenizer", "face_tokenizer", "tma", "tokens", "face_tokens", "gpt"),
    *("face_gpt", "face_vae", "face_diffusion", "generate", "evaluate", "report"),
]
FACE = "a happy face"
WAVE = ("a person waves with the left hand", "--set", f"face={FACE}", "--seconds", "2")


def arrays(path: Path) -> dict[str, Any]:
    with np.load(path, allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}


def only(folder: Path, suffix: str) -> Path:
    (path,) = folder.glob(f"*{suffix}")
    return path


@pytest.fixture(scope="module")
def copy(small_run: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run at another place, free to be changed."""
    folder = tmp_path_factory.mktemp("copy") / "run"
    shutil.copytree(small_run.folder, folder)
    return folder


@pytest.fixture(scope="module")
def motions(copy: Path, tmp_path_factory: pytest.TempPathFactory, start: Callable[..., Any]) -> Path:
    """What `generate` writes for one caption."""
    folder = tmp_path_factory.mktemp("motions")
    process = start("generate", copy, *WAVE, "--seed", 5, "-o", folder, "-f", "npz,bvh,html")
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    written = [Path(line) for line in output.splitlines() if Path(line).is_file()]
    assert {path.suffix for path in written} == {".npz", ".bvh", ".html"}
    return folder


def test_a_run_ends_with_the_page(small_run: Any) -> None:
    last = small_run.output.splitlines()[-1]
    page = Path(last.removeprefix("watch it: "))
    assert page == small_run.folder / "stages/report/report.html"
    html = page.read_text()
    assert len(html) > 100_000 and "http://" not in re.sub(r"http://www\.w3\.org/\S+", "", html)
    for number, name in enumerate(STAGES, start=1):
        assert f"[{number}/{len(STAGES)}] {name} (" in small_run.output
        artifact = Artifact.find(small_run.folder / "stages" / name)
        assert artifact is not None and artifact.outputs
        assert artifact.missing(small_run.folder / "stages" / name) is None


def test_a_second_run_does_nothing_and_says_so(
    small_run: Any, tmp_path: Path, call: Callable[..., Any]
) -> None:
    run = shutil.copytree(small_run.folder, tmp_path / "run")  # other test processes may open the first
    before = {p: p.stat().st_mtime_ns for p in run.rglob("*")}
    done = call("run", small_run.recipe, "--out", run)
    assert done.code == 0
    assert f"all {len(STAGES)} stages" in done.out
    assert done.out.splitlines()[-1] == f"watch it: {run / 'stages/report/report.html'}"
    assert {p: p.stat().st_mtime_ns for p in run.rglob("*")} == before


def test_npz_says_what_it_holds(motions: Path) -> None:
    stored = arrays(only(motions, ".npz"))
    facts = json.loads(str(stored["metadata"]))
    assert facts["caption"] == WAVE[0] and facts["face_caption"] == FACE and facts["seed"] == 5
    frames = round(2 * facts["fps"])
    assert abs(len(stored["joints"]) - frames) < 4
    assert stored["joints"].shape[1:] == (len(facts["joint_names"]), 3) == (52, 3)
    assert stored["features"].shape == (len(stored["joints"]), 313)
    assert stored["face"].shape == (len(stored["joints"]), 50)
    assert all(np.isfinite(stored[name]).all() for name in ("joints", "features", "face"))


def test_bvh_and_page_show_the_same_motion(motions: Path) -> None:
    path = only(motions, ".bvh")
    stored = arrays(only(motions, ".npz"))
    names, joints = json.loads(str(stored["metadata"]))["joint_names"], stored["joints"]
    motion = read_bvh(path)
    order = [motion.joints.index(name) for name in names]
    positions = motion.positions()[:, order] / 100
    assert np.linalg.norm(positions - joints, axis=-1).mean() < 0.05
    root = bvhio.readAsHierarchy(str(path)).loadPose(7)
    found = {joint.Name: np.array(joint.PositionWorld) / 100 for joint, _, _ in root.layout()}
    np.testing.assert_allclose([found[name] for name in names], positions[7], atol=2e-4)
    assert WAVE[0] in (motions / "index.html").read_text()


def test_same_seed_same_motion(copy: Path, motions: Path, tmp_path: Path, call: Callable[..., Any]) -> None:
    """And the face is that of the generator that is asked for."""
    faces = [("--set", f"face_model={kind}") for kind in ("vae", "diffusion")]
    first = arrays(only(motions, ".npz"))
    for seed, more, body, face in (
        (5, (), True, True), (6, (), False, False), (5, faces[0], True, False), (5, faces[1], True, False),
    ):  # fmt: skip
        out = tmp_path / str(len(list(tmp_path.iterdir())))
        assert call("generate", copy, *WAVE, "--seed", seed, "-f", "npz", "-o", out, *more).code == 0
        again = arrays(only(out, ".npz"))
        assert np.array_equal(again["joints"], first["joints"]) is body
        assert np.array_equal(again["face"], first["face"]) is face


def test_an_exported_folder_works_alone(
    small_run: Any, copy: Path, motions: Path, tmp_path: Path, call: Callable[..., Any]
) -> None:
    run, exported, elsewhere = tmp_path / "run", tmp_path / "exported", tmp_path / "else/where"
    shutil.copytree(small_run.folder, run)
    done = call("export", run, "-o", exported)
    assert done.code == 0 and "motionloom generate" in done.out
    shutil.rmtree(run)
    shutil.copytree(exported, elsewhere)
    shutil.rmtree(exported)
    files = [p for p in elsewhere.rglob("*") if p.is_file()]
    assert {p.suffix for p in files} == {".json", ".md", ".safetensors"}
    assert json.loads((elsewhere / "skeleton.json").read_text())["name"] == "smplx52"
    assert not any(str(small_run.folder.parent) in p.read_text() for p in files if p.suffix == ".json")
    out, first = tmp_path / "motions", arrays(only(motions, ".npz"))
    assert call("generate", elsewhere, *WAVE, "--seed", 5, "-f", "npz", "-o", out).code == 0
    np.testing.assert_array_equal(arrays(only(out, ".npz"))["joints"], first["joints"])
    for command in ("retrieval", "evaluate", "report", "export"):
        done = call(command, elsewhere)
        assert done.code == 2 and "an exported folder" in done.err and "name the run folder" in done.err
    MotionModel(elsewhere).save_pretrained(tmp_path / "saved")
    model = MotionModel.from_pretrained(tmp_path / "saved")
    made = model.generate([WAVE[0]], face=[FACE], seconds=2.0, seed=5)[0]
    np.testing.assert_array_equal(made.features, first["features"])
    np.testing.assert_allclose(shown(made).joints, first["joints"], atol=1e-6)  # stored in half the digits
    # A run is saved as an export, too.
    again = tmp_path / "of-run"
    MotionModel(copy).save_pretrained(again)
    text = "".join(p.read_text() for p in again.rglob("*") if p.suffix in (".json", ".md"))
    assert str(copy) not in text and MotionModel.from_pretrained(again).bundle.faces


def test_retrieval_under_four_protocols(copy: Path, call: Callable[..., Any]) -> None:
    done = call("retrieval", copy)
    assert done.code == 0
    record = json.loads((copy / "retrieval.json").read_text())
    artifact = json.loads((copy / "stages/tma/artifact.json").read_text())
    about = record["about"]
    assert about["fingerprint"] == artifact["fingerprint"] and about["split"] == "test"
    assert about["sha256"] == artifact["outputs"]["model.safetensors"]["sha256"]
    rows: dict[str, dict[str, float]] = {}
    for one in record["figures"]:
        if "row" not in one:
            protocol, _, name = one["name"].partition(".")
            rows.setdefault(protocol, {})[name] = one["value"]
    assert list(rows) == list("ABCD")
    whole, threshold = rows["A"], rows["B"]
    for k in (1, 2, 3, 5, 10):
        assert f"R@{k}" in done.out
        assert threshold[f"t2m/R@{k}"] >= whole[f"t2m/R@{k}"], "more counts as a hit"
    assert whole["t2m/R@1"] <= whole["t2m/R@3"] <= whole["t2m/R@10"] <= 1


def test_retrieval_by_another_alignment_stage(
    small_run: Any, tmp_path: Path, call: Callable[..., Any]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(small_run.folder, run)
    done = call("retrieval", run, "--stage", "temos")
    assert done.code == 2 and "no stage 'temos'" in done.err and "this run has tma" in done.err
    assert "face_vae" not in done.err
    recipe = yaml.safe_load((run / "recipe.yaml").read_text())
    recipe["stages"]["temos"] = recipe["stages"]["tma"]
    (run / "recipe.yaml").write_text(yaml.safe_dump(recipe, sort_keys=False))
    unfinished = call("retrieval", run, "--stage", "temos")
    assert unfinished.code == 2 and "no finished 'temos' stage" in unfinished.err
    shutil.copytree(run / "stages/tma", run / "stages/temos")
    weights = load_file(run / "stages/temos/model.safetensors")
    weights["text_encoder.project.weight"] *= -1
    save_file(weights, run / "stages/temos/model.safetensors")
    damaged = call("retrieval", run, "--stage", "temos")
    assert damaged.code == 2 and "temos/model.safetensors: " in damaged.err
    artifact = Artifact.find(run / "stages/temos")
    assert artifact is not None
    artifact.finish(run / "stages/temos")
    assert call("retrieval", run).code == 0
    other = call("retrieval", run, "--stage", "temos")
    assert other.code == 0
    ours, theirs = (json.loads((run / f"retrieval{x}.json").read_text()) for x in ("", "-temos"))
    assert ours["about"]["stage"] == "tma" and theirs["about"]["stage"] == "temos"
    assert len(ours["figures"]) == len(theirs["figures"]) and ours["figures"] != theirs["figures"]


def test_evaluate_and_report_again(copy: Path, tmp_path: Path, call: Callable[..., Any]) -> None:
    done = call("evaluate", copy, "--clips", 4, "--repeats", 2)
    assert done.code == 0 and "nearest training clip" in done.out and len(done.out.splitlines()) < 20
    assert done.out.strip().endswith(str(copy / "evaluate/figures.html"))
    file = FigureFile.read(copy / "evaluate/metrics.json")
    mpjpe, face, top = (file.of(name) for name in ("reconstruction.mpjpe", "face.expression", "tma.top-1"))
    assert mpjpe is not None and face is not None and top is not None
    assert mpjpe.value > 0 and (mpjpe.protocol["clips"], mpjpe.protocol["split"]) == (4, "test")
    assert face.value > 0 and "of fewer than 10 clips" in done.out
    for wanted in ("expression error", "Where it errs", "worst 1", "mm at each joint"):
        assert wanted in (copy / "evaluate/figures.html").read_text()
    assert top.protocol["candidates"] in (2, 3, 4), "61 wrong captions, or as many as there are"
    for row in (MODEL, RECORDED):
        first, fifth = file.of("tma.top-1", row), file.of("tma.top-5", row)
        assert first is not None and fifth is not None and 0 <= first.value <= fifth.value <= 1
    for wrong in (("--repeats", 0), ("--clips", -4)):
        done = call("evaluate", copy, *wrong)
        assert done.code == 2 and f"evaluate: key '{wrong[0][2:]}' = {wrong[1]}" in done.err
    page = tmp_path / "new/folder/page.html"
    done = call("report", copy, "-o", page)
    assert done.code == 0 and done.out.strip() == str(page)
    for wanted in ("Figures on held-out clips", "gpt: loss", "gpt: learning rate", "gpt: tokens a second"):
        assert wanted in page.read_text()
