"""GLB and BVH files in Blender itself: bones where ours are, upright, left on the left, actions, shape keys.

Runs where `MOTIONLOOM_BLENDER` names a Python that has Blender as a module: `pip install bpy` in an
environment of its own.
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from motionloom.datasets.motion.bvh import write_bvh
from motionloom.datasets.motion.rigid import RigidMotion, fit_rigid
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.body.face import EXPRESSIONS
from motionloom.pipeline.render.body.glb import GlbClip, write_glb

SKELETON = Skeleton.named("smplx52")
FPS, FRAMES = 20, 30
SCRIPT = Path(__file__).parents[2] / "helpers" / "blender_import.py"


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Path], Any]:
    """What Blender finds in a file."""
    python = os.environ.get("MOTIONLOOM_BLENDER")
    if not python:
        pytest.skip("MOTIONLOOM_BLENDER names no Python with Blender's module (bpy)")

    def go(path: Path) -> Any:
        out = tmp_path_factory.mktemp("blender") / "found.json"
        words = [python, str(SCRIPT), str(path), str(FPS), str(FRAMES), str(out)]
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        done = subprocess.run(words, capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        return json.loads(out.read_text())

    return go


@pytest.fixture(scope="module")
def figure(walk: Callable[..., NDArray[np.float64]]) -> RigidMotion:
    """A walk with the left hand up."""
    return fit_rigid(walk(FRAMES, wave=True), SKELETON)


def require_bones(found: Any, figure: RigidMotion) -> None:
    """Blender has Z up, and its front view looks along +Y: (x, y, z) of glTF is (x, -z, y) there."""
    there = np.array([[bones[name] for name in SKELETON.joints] for bones in found["bones"]])
    here = figure.joints[:FRAMES][..., [0, 2, 1]] * [1.0, -1.0, 1.0]
    np.testing.assert_allclose(there, here, atol=1e-5)
    head, wrist = (there[:, SKELETON.joints.index(name)] for name in ("head", "left_wrist"))
    assert 1.3 < head[:, 2].mean() < 1.8, "upright, in metres"
    assert wrist[0, 0] > 0.2, "it faces the front view, so its left is at +X"


def test_a_glb_with_several_motions(imported: Any, figure: RigidMotion, tmp_path: Path) -> None:
    rise = np.linspace(0, 1, FRAMES)[:, None] * np.eye(len(EXPRESSIONS))[0]
    clips = [GlbClip("a wave", figure, FPS, rise), GlbClip("the same again", figure, FPS)]
    written = write_glb(tmp_path / "motions.glb", clips)
    found = imported(tmp_path / "motions.glb")
    assert found["actions"] == {name: [0, FRAMES - 1] for name in ("a wave", "the same again")}
    assert found["playing"] == "a wave"
    assert found["meshes"] == {"body": 52, "head": 52}
    assert found["shapes"] == {"head": ["Basis", *EXPRESSIONS]}
    rest = np.array(found["rest"])
    assert abs(rest[:, 2].min()) < 1e-4 and 1.5 < rest[:, 2].max() < 2.0, "at rest it stands on the floor"
    require_bones(found, written[0])


def test_a_bvh(imported: Any, figure: RigidMotion, tmp_path: Path) -> None:
    write_bvh(tmp_path / "wave.bvh", figure.skeleton, figure.rotations, figure.root, FPS)
    found = imported(tmp_path / "wave.bvh")
    assert found["fps"] == pytest.approx(FPS)
    ((begin, end),) = found["actions"].values()
    assert end - begin == FRAMES - 1
    require_bones(found, figure)
