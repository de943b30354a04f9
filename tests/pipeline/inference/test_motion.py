"""A motion and its files: facts, formats (one more is one function and one line), what a notebook shows."""

from __future__ import annotations

import base64
import errno
import html
import json
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.optimize import lsq_linear

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body import feet
from motionloom.datasets.motion.body.expressions import APEX, BASIS
from motionloom.datasets.motion.bvh.motion import read_bvh
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.features.joints import joints_of, rotations_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.inference.checks import STANDS, standing
from motionloom.pipeline.inference.files.display_figure import FAR_MM, FigureOptions, shown
from motionloom.pipeline.inference.files.outputs import write_motions
from motionloom.pipeline.inference.files.writers import WRITERS, default_formats
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.serve.requests import MotionRequest
from motionloom.pipeline.stages.results.generate import GenerateConfig

NASTY = "a \"person\" </iframe><script>window.hacked=1</script> & 'waves'"


@pytest.fixture
def motion(walk: Callable[..., Any]) -> GeneratedMotion:
    layout = MotionLayout.named("wholebody363", fps=20.0)
    features = np.zeros((30, 313), np.float32)
    return GeneratedMotion(Prompt(NASTY), features, walk(30), None, layout, seed=9)


@pytest.mark.parametrize("ending", [".npz", ".bvh", ".glb", ".html", ".BVH"])
def test_saves_by_its_ending(motion: GeneratedMotion, tmp_path: Path, ending: str) -> None:
    path = motion.save(tmp_path / f"made{ending}")
    start = {"npz": b"PK", "bvh": b"HIER", "glb": b"glTF", "html": b"<!doctype html>"}
    assert path.read_bytes().startswith(start[ending.lower()[1:]])
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_endings_that_are_none(motion: GeneratedMotion, tmp_path: Path) -> None:
    with pytest.raises(
        UserError, match=r"cannot be saved with '\.fbx'; name a file that ends in \.npz, \.bvh"
    ):
        motion.save(tmp_path / "made.fbx")
    with pytest.raises(UserError, match="no ending"):
        motion.save(tmp_path / "made")
    for ending in (writer.suffix for writer in WRITERS.values()):
        with pytest.raises(UserError, match=r"there is no folder .*missing; make it first"):
            motion.save(tmp_path / "missing" / f"made{ending}")
    assert not list(tmp_path.iterdir())


def test_a_notebook_shows_it_apart(motion: GeneratedMotion) -> None:
    assert repr(motion) == f"GeneratedMotion({NASTY!r}, 1.5 s, 30 frames, 52 joints)"
    tags: list[tuple[str, dict[str, str | None]]] = []
    reader = HTMLParser()
    reader.handle_starttag = lambda tag, attrs: tags.append((tag, dict(attrs)))  # type: ignore[method-assign]
    reader.feed(motion._repr_html_())
    ((tag, attributes),) = tags  # one frame and nothing else, whatever the caption says
    assert tag == "iframe" and attributes["sandbox"] == "allow-scripts" and attributes["title"] == NASTY
    page = attributes["srcdoc"] or ""
    assert page.startswith("<!doctype html>") and "default-src 'none'" in page
    assert "<script>window.hacked" not in page
    assert not re.search(r"""(?:src|href)=["']?https?:""", page)
    assert html.unescape(page).count("motionloomViewer(") >= 1


@pytest.mark.browser
def test_it_plays_in_the_frame(motion: GeneratedMotion, browser: Any, until: Any, tmp_path: Path) -> None:
    path = tmp_path / "notebook.html"
    path.write_text(f"<!doctype html><body>{motion._repr_html_()}</body>", encoding="utf-8")
    page = browser.new_page(viewport={"width": 800, "height": 600})
    try:
        page.goto(path.as_uri())
        page.wait_for_timeout(300)
        frame = page.frames[1]
        until(frame, "window.__viewer && window.__viewer.draws > 1")
        assert frame.evaluate("__viewer.frames") == 30
        assert frame.locator("figcaption").text_content() == NASTY
        assert frame.evaluate("window.hacked") is None and page.evaluate("window.hacked") is None
        page.screenshot(path=str(tmp_path / "notebook.png"))
    finally:
        page.close()


def test_formats_are_names_of_the_table() -> None:
    assert default_formats() == ["npz", "html"]  # other files only where it is asked for
    with pytest.raises(UserError, match="formats"):
        GenerateConfig.parse({"formats": ["npz", "fbx"]}, "generate")
    with pytest.raises(ValidationError):
        MotionRequest(caption="a", format="fbx")


# One figure in every output: page, npz, BVH, GLB and SMPL-X files of one motion agree.

LAYOUT = MotionLayout.named("wholebody363")


@pytest.fixture(scope="module")
def motions(walk: Callable[..., NDArray[np.float64]]) -> list[GeneratedMotion]:
    """Two motions whose bones change from frame to frame by up to a tenth; the first has a face."""
    rng = np.random.default_rng(0)
    out = []
    for number, wave in enumerate((False, True)):
        joints = walk(24, LAYOUT.fps, wave=wave)
        clean = joints.copy()
        for joint, parent in enumerate(LAYOUT.skeleton.parents[1:], start=1):
            factor = rng.uniform(0.9, 1.1, size=(24, 1))
            joints[:, joint] = joints[:, parent] + factor * (clean[:, joint] - clean[:, parent])
        features = encode(joints, LAYOUT)[:, LAYOUT.part("bodyhand")]
        face = None if number else np.tile(APEX * BASIS[:, 0], (24, 1)).astype(np.float32)
        prompt = Prompt(text="a person waves" if wave else "a person walks")
        out.append(GeneratedMotion(prompt, features, joints, face, LAYOUT))
    return out


def write(folder: Path, motions: list[GeneratedMotion], **options: Any) -> tuple[list[Path], list[str]]:
    said: list[str] = []
    figure = FigureOptions.parse(options, "figure")
    formats = ["npz", "bvh", "html", "glb", "smplx"]
    paths = write_motions(folder, motions, formats, title="t", figure=figure, say=said.append)
    return paths, said


def page_joints(page: Path, number: int) -> NDArray[np.float64]:
    """Joints [T, N, 3] of one cell of a page, from its own data."""
    text = page.read_text(encoding="utf-8")
    found = re.search(r'<script[^>]*type="application/json"[^>]*>(.*?)</script>', text, re.S)
    assert found
    clip = json.loads(found[1])["motions"][number]
    whole = np.frombuffer(base64.b64decode(clip["positions"]), "<u2").reshape(clip["frames"], -1, 3)
    return np.asarray(clip["low"]) + np.asarray(clip["step"]) * whole


def test_all_files_show_one_figure_of_constant_bones(motions: list[GeneratedMotion], tmp_path: Path) -> None:
    paths, said = write(tmp_path / "out", motions)
    names = [path.name for path in paths]
    assert names == [
        "00-a-person-walks.npz", "00-a-person-walks.bvh", "00-a-person-walks.glb",
        "00-a-person-walks_smplx.npz", "01-a-person-waves.npz", "01-a-person-waves.bvh",
        "01-a-person-waves.glb", "01-a-person-waves_smplx.npz", "motions.glb", "index.html",
    ]  # fmt: skip
    assert all(path.is_file() for path in paths)
    parents = list(LAYOUT.skeleton.parents[1:])
    for number, motion in enumerate(motions):
        with np.load(paths[4 * number], allow_pickle=False) as file:
            joints, facts = file["joints"].astype(np.float64), json.loads(str(file["metadata"]))
            np.testing.assert_array_equal(file["features"], motion.features)
        lengths = np.linalg.norm(joints[:, 1:] - joints[:, parents], axis=-1)
        assert np.ptp(lengths, axis=0).max() < 1e-5  # float32
        away = np.linalg.norm(joints - motion.joints, axis=-1) * 1000
        assert facts["figure"]["fit_mean_mm"] == pytest.approx(away.mean(), abs=1e-2)
        assert facts["figure"]["fit_max_mm"] == pytest.approx(away.max(), abs=1e-2)
        far = away.mean() > FAR_MM
        assert far == any(f"{away.mean():.1f} mm on average" in line for line in said)
        bvh = read_bvh(paths[4 * number + 1])
        order = [bvh.joints.index(name) for name in LAYOUT.skeleton.joints]
        np.testing.assert_allclose(bvh.positions()[:, order] / 100, joints, atol=2e-5)
        np.testing.assert_allclose(page_joints(paths[-1], number), joints, atol=1e-4)
    alone = motions[0].save(tmp_path / "alone.glb")
    a, b = (pygltflib.GLTF2().load(path) for path in (alone, paths[2]))
    assert a.binary_blob() == b.binary_blob()
    together = pygltflib.GLTF2().load(tmp_path / "out" / "motions.glb")
    assert [animation.name for animation in together.animations] == ["a person walks", "a person waves"]
    paths_of = [[c.target.path for c in animation.channels] for animation in together.animations]
    assert ["weights" in found for found in paths_of] == [True, False]


def test_new_motions_take_the_place_of_old_ones(
    motions: list[GeneratedMotion], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    write(out, motions)
    (out / "notes.txt").write_text("mine")
    (out / "mine.npz").write_text("mine")
    names = ["歩く ひと", "шаг_вперёд"]
    paths = write_motions(out, motions, ["npz", "html"], title="t", names=names)
    assert [path.name for path in paths] == ["00-歩く-ひと.npz", "01-шаг-вперёд.npz", "index.html"]
    left = {path.name for path in out.iterdir() if not path.name.startswith(".")}
    assert left == {"notes.txt", "mine.npz", *(path.name for path in paths)}
    for formats, said in ((["npy"], "npy: no such format"), ("npz", "give a list"), ([], "give a list")):
        with pytest.raises(UserError, match=said):
            write_motions(str(out), iter(motions), formats, title="t")
    assert all(path.is_file() for path in paths)
    # What they are made from stays, and all of it does where they cannot be written.
    write_motions(out, motions, ["npz"], title="t", made_from=out / "00-歩く-ひと.npz")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert "00-歩く-ひと.npz" in before and "01-шаг-вперёд.npz" not in before

    def full(path: Path, outputs: object) -> None:
        path.write_text("half")
        raise OSError(errno.ENOSPC, "full", str(path))

    monkeypatch.setitem(WRITERS._things, "html", replace(WRITERS["html"], write=full))
    with pytest.raises(OSError, match=re.escape(str(out / "index.html"))):
        write_motions(out, motions, ["npz", "html"], title="t", names=names)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_faces_are_written_as_arkit_weights_by_the_users_bases(
    motions: list[GeneratedMotion], tmp_path: Path
) -> None:
    """A basis whose 50 values are the first 50 shapes: weights are the values, cut to 0..1."""
    arkit = np.random.default_rng(0).normal(size=(52, 70, 3))
    np.savez(tmp_path / "bases.npz", source=arkit[:50], arkit=arkit)
    options = FigureOptions(arkit_bases=tmp_path / "bases.npz")
    paths = write_motions(
        tmp_path / "out", motions[:1], ["arkit", "glb"], title="t", figure=options
    )  # fmt: skip
    assert [path.name for path in paths] == ["00-a-person-walks.glb", "00-a-person-walks_arkit.csv"]
    rows = np.loadtxt(paths[1], delimiter=",", skiprows=1)
    assert rows.shape == (24, 53)
    assert motions[0].face is not None
    meant = motions[0].face[0] @ arkit[:50].reshape(50, -1)
    reference = lsq_linear(arkit.reshape(52, -1).T, meant, bounds=(0, 1)).x
    np.testing.assert_allclose(rows[0, 1:], reference, atol=1e-3)
    assert len(pygltflib.GLTF2().load(paths[0]).meshes[1].primitives[0].targets) == 52
    with pytest.raises(UserError, match="makes no face"):
        write_motions(tmp_path / "no", motions, ["arkit"], title="t")


def test_a_dance_on_the_spot_has_a_note(motions: list[GeneratedMotion]) -> None:
    hum = Sound(np.sin(np.arange(80_000) / 20).astype(np.float32), 10_000)
    dance = Prompt(text="a person dances", sound=hum)
    still = np.repeat(motions[0].joints[:1], int(STANDS * LAYOUT.fps) + 9, axis=0)
    moves = still + np.arange(len(still))[:, None, None] * [0, 0, 0.05]
    made = [replace(motions[0], prompt=dance, joints=joints) for joints in (still, moves, still[:60])]
    assert len(standing(made)) == len(standing(made[:1])) == 1
    assert standing([replace(made[0], prompt=motions[0].prompt)]) == []


def test_planted_feet_say_what_they_cost(
    motions: list[GeneratedMotion], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Trembling bones make the feet of these walks fast: they stand by a looser rule.
    monkeypatch.setattr(feet, "HEIGHT", 0.1)
    monkeypatch.setattr(feet, "SPEED", 2.0)
    plain = shown(motions[0], FigureOptions(plant_feet=False))
    planted = shown(motions[0])
    assert planted.feet is not None and plain.feet is None
    facts = planted.facts()
    assert facts["slide_after_cm_s"] < facts["slide_before_cm_s"]
    assert facts["fit_unplanted_mean_mm"] == plain.facts()["fit_mean_mm"] < facts["fit_mean_mm"]
    assert motions[0].joints is planted.motion.joints  # what is measured stays as it was


@pytest.mark.parametrize(("name", "count"), [("smpl75", 22), ("smplx322", 52), ("h3d263", 22)])
def test_every_family_of_layouts_has_a_figure(name: str, count: int) -> None:
    """Raw parameters keep their own rotations; contact columns say when feet stand."""
    layout = MotionLayout.named(name)
    features = 0.1 * np.random.default_rng(3).normal(size=(12, layout.dim)).astype(np.float32)
    motion = GeneratedMotion(Prompt("x"), features, joints_of(features, layout), None, layout)
    figure = shown(motion)
    assert figure.joints.shape == (12, count, 3) and np.isfinite(figure.joints).all()
    plain = shown(motion, FigureOptions(plant_feet=False))
    if layout.family == "raw":
        assert plain.figure.error.max_mm < 1e-3
        known = rotations_of(features, layout)
        assert known is not None
        np.testing.assert_allclose(plain.figure.rotations, known, atol=1e-5)
