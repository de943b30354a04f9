"""ARKit's shapes on the body's head, the synthetic face by its own bases, and both in files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pygltflib
from numpy.typing import NDArray

from motionloom.datasets.motion.arkit import ARKIT
from motionloom.datasets.motion.rigid import fit_rigid
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.synth.face import APEX, BASIS
from motionloom.pipeline.render.body.arkit_face import own_bases, synthetic_arkit
from motionloom.pipeline.render.body.face import expression_weights
from motionloom.pipeline.render.body.glb import GlbClip, write_glb
from motionloom.pipeline.render.body.mesh import neutral_body

SKELETON = Skeleton.named("smplx52")


def test_shapes_have_their_side_and_together_make_the_whole() -> None:
    body = neutral_body("smplx52", "arkit")
    assert list(body.expressions) == list(ARKIT)
    left = body.vertices[:, 0] > 0
    blink = {side: np.linalg.norm(body.expressions[f"eyeBlink{side}"], axis=-1) for side in ("Left", "Right")}
    assert blink["Left"][left].max() > 0.005 > 1e-3 > blink["Left"][~left].max()
    assert blink["Right"][~left].max() > 0.005
    both = body.expressions["eyeBlinkLeft"] + body.expressions["eyeBlinkRight"]
    whole = neutral_body().expressions["blink"]
    np.testing.assert_allclose(both, whole, atol=5e-4)
    assert not body.expressions["tongueOut"].any()
    np.testing.assert_array_equal(body.vertices, neutral_body().vertices)


def test_synthetic_faces_become_the_shapes_that_mean_them() -> None:
    rows = np.stack(
        [0 * BASIS[:, 0], APEX * BASIS[:, 0], APEX * BASIS[:, 1], APEX * BASIS[:, 3], 1.6 * BASIS[:, 4]]
    )
    weights = synthetic_arkit(rows)
    named = [dict(zip(ARKIT, row, strict=True)) for row in weights]
    assert weights[0].max() < 1e-6
    happy, sad, surprised, blink = named[1:]
    assert min(happy["mouthSmileLeft"], happy["mouthSmileRight"]) > 0.6
    assert min(sad["mouthFrownLeft"], sad["browInnerUp"]) > 0.4
    assert min(surprised["eyeWideLeft"], surprised["jawOpen"], surprised["browOuterUpRight"]) > 0.5
    assert min(blink["eyeBlinkLeft"], blink["eyeBlinkRight"]) > 0.9
    assert max(blink["jawOpen"], blink["mouthSmileLeft"]) < 0.05
    assert own_bases().residual(expression_weights(rows), weights) < 0.35


def test_glb_carries_all_fifty_two(walk: Callable[..., NDArray[np.float64]], tmp_path: Path) -> None:
    figure = fit_rigid(walk(8), SKELETON)
    weights = synthetic_arkit(np.linspace(0, 1, 8)[:, None] * APEX * BASIS[:, 0])
    write_glb(tmp_path / "a.glb", [GlbClip("smile", figure, 20.0, weights)], "arkit")
    gltf = pygltflib.GLTF2().load(tmp_path / "a.glb")
    assert gltf.meshes[1].extras["targetNames"] == list(ARKIT)
    targets = gltf.meshes[1].primitives[0].targets
    assert len(targets) == 52
    stored = {target["POSITION"] for target in targets}
    assert len([number for number in stored if gltf.accessors[number].bufferView is None]) == 1
    channel = next(c for c in gltf.animations[0].channels if c.target.path == "weights")
    keys = gltf.accessors[gltf.animations[0].samplers[channel.sampler].output]
    assert keys.count == 8 * 52
