"""SMPL parameters to joints: golden vectors, a slow reference, made-up mesh models, and model files."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.smpl import BodyModel, SkeletonName, smpl_joints
from motionloom.datasets.motion.npz import NpzFile
from motionloom.datasets.motion.skeleton import Skeleton

SMPL_TREE = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19]
FINGER_STARTS = [0, 3, 6, 9, 12]


def tree_of(joints: int) -> list[int]:
    """Parents of SMPL (24), SMPL-H (52) or SMPL-X (55), as their files have them."""
    parents = list(SMPL_TREE)
    if joints == 24:
        return [*parents, 20, 21]
    if joints == 55:
        parents += [15, 15, 15]
    for wrist in (20, 21):
        start = len(parents)
        parents += [wrist if i in FINGER_STARTS else start + i - 1 for i in range(15)]
    return parents


def rodrigues(vector: list[float]) -> NDArray[np.float64]:
    x, y, z = vector
    return np.asarray(expm([[0, -z, y], [z, 0, -x], [-y, x, 0]]))


def made_up_model(joints: int, shapes: int = 10, *, rigid: bool = False, seed: int = 0) -> dict[str, Any]:
    """A body model of the right form with random content.

    `rigid`: each joint is regressed from vertices that move with it alone, so that regressing the posed mesh
    must give the posed joints.
    """
    rng = np.random.default_rng(seed)
    vertices = 6 * joints
    regressor = np.zeros((joints, vertices))
    weights = rng.dirichlet(np.full(joints, 0.1), size=vertices)
    if rigid:
        weights = np.zeros((vertices, joints))
    for joint in range(joints):
        own = slice(6 * joint, 6 * joint + 6)
        regressor[joint, own] = rng.dirichlet(np.ones(6))
        if rigid:
            weights[own, joint] = 1.0
    tree = np.array([tree_of(joints), range(joints)], dtype=np.int64).astype(np.uint32)
    return {
        "J_regressor": regressor,
        "v_template": rng.normal(size=(vertices, 3)),
        "shapedirs": 0.1 * rng.normal(size=(vertices, 3, shapes)),
        "posedirs": (0.0 if rigid else 0.01) * rng.normal(size=(vertices, 3, 9 * (joints - 1))),
        "kintree_table": tree,  # the root's parent is 2^32 - 1, as in the published files
        "weights": weights,
    }


def posed_mesh(
    model: dict[str, Any], rotvecs: NDArray[Any], trans: NDArray[Any], betas: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Vertices [V, 3] and joints [J, 3] of one frame by linear blend skinning with 4 x 4 matrices."""
    parents = tree_of(len(model["J_regressor"]))
    shaped = model["v_template"] + model["shapedirs"][:, :, : len(betas)] @ betas
    rest = model["J_regressor"] @ shaped
    local = np.array([rodrigues(r) for r in rotvecs.tolist()])
    posed = shaped + np.dot(model["posedirs"], np.ravel(local[1:] - np.eye(3)))
    world = []
    for joint, parent in enumerate(parents):
        step = np.eye(4)
        step[:3, :3] = local[joint]
        step[:3, 3] = rest[joint] - (rest[parent] if parent >= 0 else 0)
        world.append(world[parent] @ step if parent >= 0 else step)
    moves = []
    for joint, matrix in enumerate(world):
        back = np.eye(4)
        back[:3, 3] = -rest[joint]
        moves.append(matrix @ back)
    blend = np.tensordot(model["weights"], np.array(moves), axes=1)
    vertices = np.einsum("vij,vj->vi", blend[:, :3, :3], posed) + blend[:, :3, 3] + trans
    return vertices, np.array([matrix[:3, 3] for matrix in world]) + trans


def chosen(joints: int, skeleton: SkeletonName) -> list[int]:
    return [*range(22), *range(joints - 30, joints)] if skeleton == "smplx52" else list(range(22))


def test_golden_body_joints(shared: Path) -> None:
    """Poses of t4 (every 2nd frame) and joints of t1 (every 3rd) share every 6th frame of one AIST++ clip.

    The bones are taken from frame 0; the other 49 frames must follow.
    """
    poses = np.load(shared / "golden/t4_motionx322_A.npz", allow_pickle=False)["motion322"][::3]
    joints = np.load(shared / "golden/t1_humanml3d_A.npz", allow_pickle=False)["aist__joints"][::2]
    rotvecs = poses[:50, :66].reshape(-1, 22, 3).astype(np.float64)
    joints = joints[:50].astype(np.float64)
    rest = unposed(rotvecs[0], joints[0], list(Skeleton.named("smpl22").parents))
    body = BodyModel(Skeleton.named("smpl22"), rest - rest[0], np.zeros((22, 3, 0)), {})
    made = smpl_joints(rotvecs, poses[:50, 309:312], body)
    np.testing.assert_allclose(made, joints, atol=1e-6)


def unposed(rotvecs: NDArray[Any], joints: NDArray[Any], parents: list[int]) -> NDArray[np.float64]:
    """Rest joints of a posed frame."""
    world = [rodrigues(rotvecs[0].tolist())]
    rest = [np.zeros(3)]
    for joint, parent in enumerate(parents[1:], start=1):
        world.append(world[parent] @ rodrigues(rotvecs[joint].tolist()))
        rest.append(rest[parent] + world[parent].T @ (joints[joint] - joints[parent]))
    return np.array(rest)


@pytest.mark.parametrize(
    ("joints", "skeleton"), [(24, "smpl22"), (52, "smpl22"), (55, "smpl22"), (52, "smplx52"), (55, "smplx52")]
)
@pytest.mark.parametrize("rigid", [False, True])
def test_joints_of_a_mesh_model(joints: int, skeleton: SkeletonName, rigid: bool, tmp_path: Path) -> None:
    model = made_up_model(joints, rigid=rigid)
    path = tmp_path / "model.npz"
    np.savez(path, **model)
    body = BodyModel.load(path, skeleton)
    rng = np.random.default_rng(2)
    rotvecs, trans = rng.normal(size=(4, joints, 3)), rng.normal(size=(4, 3))
    rotvecs[0, ::2] = 0.0
    rotvecs[1] *= 1e-9
    rotvecs[2] *= math.pi / np.linalg.norm(rotvecs[2], axis=-1, keepdims=True)
    betas = rng.normal(size=10)
    mine = chosen(joints, skeleton)
    made = smpl_joints(rotvecs[:, mine], trans, body, betas)
    for frame in range(4):
        vertices, posed = posed_mesh(model, rotvecs[frame], trans[frame], betas)
        np.testing.assert_allclose(made[frame], posed[mine], atol=1e-12)
        regressed = model["J_regressor"] @ vertices
        close = np.allclose(regressed[mine], posed[mine], atol=1e-9)
        assert (
            close == rigid or frame == 1
        )  # through a soft mesh they are other points, which is why nobody wants them


def test_statement_names_the_file_and_the_kind(tmp_path: Path) -> None:
    path = tmp_path / "SMPLH_NEUTRAL.npz"
    np.savez(path, **made_up_model(52, shapes=16))
    statement = BodyModel.load(path, "smpl22").statement
    assert (statement["kind"], statement["file"], statement["shape_values"]) == ("SMPL-H", path.name, 16)
    assert len(statement["sha256"]) == 64 and str(tmp_path) not in str(statement)
    assert "No body model" in BodyModel.neutral("smpl22").statement["sentence"]


def test_shape_values_may_be_fewer_or_more_than_the_model_has(tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    np.savez(path, **made_up_model(52))
    body = BodyModel.load(path, "smpl22")
    betas = np.random.default_rng(3).normal(size=16)
    short = np.concatenate([betas[:4], np.zeros(6)])
    np.testing.assert_array_equal(body.rest_joints(betas), body.rest_joints(betas[:10]))
    np.testing.assert_allclose(body.rest_joints(betas[:4]), body.rest_joints(short), atol=1e-15)
    np.testing.assert_array_equal(body.rest_joints(None), body.template)
    neutral = BodyModel.neutral("smpl22")
    np.testing.assert_array_equal(neutral.rest_joints(betas), neutral.template)
    with pytest.raises(UserError, match=r"betas are \[1, 10\]"):
        body.rest_joints(betas[None, :10])


def test_pickles_are_never_opened(tmp_path: Path) -> None:
    path = tmp_path / "basicModel_neutral.pkl"
    path.write_bytes(b"anything")
    with pytest.raises(UserError, match=r"basicModel_neutral.pkl is a pickle.*numpy\.savez"):
        BodyModel.load(path, "smpl22")
    model = made_up_model(24) | {"J_regressor": np.array([{"a": 1}], dtype=object)}
    np.savez(tmp_path / "model.npz", allow_pickle=True, **model)
    with pytest.raises(UserError, match="'J_regressor': object array"):
        BodyModel.load(tmp_path / "model.npz", "smpl22")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kintree_table": np.array([[0, 0], [0, 1]])}, r"kintree_table is \[2, 2\]"),
        ({"kintree_table": np.array([[*tree_of(24)[:23], 3], range(24)])}, ""),
        ({"kintree_table": np.array([[*tree_of(24)[:21], 3, 20, 21], range(24)])}, "kintree_table"),
        ({"v_template": np.zeros((144, 2))}, r"v_template is \[144, 2\]"),
        ({"shapedirs": np.zeros((10, 3, 10))}, r"shapedirs is \[10, 3, 10\], not \[144, 3, B\]"),
        ({"J_regressor": np.zeros((24, 5))}, r"J_regressor is \[24, 5\], not \[24, 144\]"),
        ({"v_template": np.full((144, 3), np.nan)}, "NaN .*v_template"),
        ({"J_regressor": np.full((24, 144), "x")}, "'J_regressor' has type <U1, not numbers"),
    ],
)
def test_wrong_models_are_refused(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    np.savez(path, **(made_up_model(24) | change))
    if not message:  # joints 22 and 23 are not ours
        BodyModel.load(path, "smpl22")
        return
    with pytest.raises(UserError, match=message) as caught:
        BodyModel.load(path, "smpl22")
    assert str(path) in str(caught.value)


def test_missing_arrays_fingers_and_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    np.savez(path, **made_up_model(24))
    with pytest.raises(UserError, match=r"SMPL .*smplx52"):
        BodyModel.load(path, "smplx52")
    np.savez(path, **{k: v for k, v in made_up_model(24).items() if k != "shapedirs"})
    with pytest.raises(UserError, match="'shapedirs'"):
        BodyModel.load(path, "smpl22")
    with pytest.raises(UserError, match=r"none\.npz"):
        BodyModel.load(tmp_path / "none.npz", "smpl22")


def test_npz_reads_headers_and_refuses_what_does_not_fit(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    values = np.asfortranarray(np.random.default_rng(0).normal(size=(7, 5)))
    np.savez_compressed(path, good=values, big=values.astype(">f4"), text="male", nothing=np.zeros((0, 3)))
    with NpzFile(path) as file:
        assert file.names == {"good", "big", "text", "nothing"}
        assert (file.header("good").shape, file.header("good").dtype) == ((7, 5), np.float64)
        np.testing.assert_array_equal(file.numbers("good"), values)
        np.testing.assert_array_equal(file.numbers("big"), values.astype(np.float32))
        assert file.array("text").item() == "male" and file.array("nothing").shape == (0, 3)
        with pytest.raises(UserError, match=r"'good' .*408 .*100"):
            file.array("good", limit=100)

    header = b"\x93NUMPY\x01\x00"
    text = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("huge.npy", header + len(text).to_bytes(2, "little") + text + bytes(8))
        archive.writestr("text.npy", b"hello")
        archive.writestr("bad.npy", header + b"\x05\x00(((((")
    with NpzFile(path, "label") as file:
        with pytest.raises(UserError, match=r"^label: array 'huge'.* 80000"):
            file.array("huge")
        for name in ("text", "bad"):
            with pytest.raises(UserError, match=f"^label: array '{name}'"):
                file.header(name)
