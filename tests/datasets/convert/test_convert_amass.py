"""AMASS conversion: made-up clips in the published form, and files that are broken."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.convert.captions.humanml_index import IndexRow, clip_key, read_index
from motionloom.datasets.convert.common.splits import hash_split
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.convert.sets.amass import AmassConfig
from motionloom.datasets.motion.body.smpl import BodyModel, smpl_joints
from motionloom.datasets.motion.canonical import canonicalize, mirror
from motionloom.datasets.motion.features.codec import decode
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import MotionLayout


@pytest.mark.parametrize("fps", [60.0, 100.0, 120.0, 150.0, 250.0, 59.94])
def test_every_frame_rate_gives_the_same_motion(amass: ModuleType, fps: float, tmp_path: Path) -> None:
    amass.save(tmp_path / "in/KIT/3/walk_poses.npz", **amass.walk(fps))
    manifest = amass.make(tmp_path / "in", tmp_path / "out")
    (motion,) = amass.features(tmp_path / "out").values()
    joints = decode(motion, MotionLayout.named("body133"))
    wanted = amass.expected_joints(20.0)[: len(joints)]
    assert len(joints) in (60, 61)
    # Linear interpolation between 60 Hz frames bends an arc by less than 0.2 mm.
    np.testing.assert_allclose(joints, wanted, atol=3e-4)
    assert (manifest.layout, manifest.fps, manifest.licence) == ("body133", 20.0, "AMASS-noncommercial")


def test_smplh_smplx_and_parts_agree_and_fingers_come_from_the_hands(
    amass: ModuleType, tmp_path: Path
) -> None:
    clip = amass.walk(120.0)
    source = tmp_path / "in"
    amass.save(source / "CMU/01/h_poses.npz", **clip)
    amass.save(source / "CMU/01/x_stageii.npz", **amass.as_smplx(clip))
    amass.save(source / "CMU/01/parts_stageii.npz", **amass.in_parts(clip))
    amass.save(source / "CMU/01/still_poses.npz", **amass.walk(120.0, hands=False))
    amass.save(source / "CMU/01/body_poses.npz", **(clip | {"poses": clip["poses"][:, :72]}))
    manifest = amass.make(source, tmp_path / "out", layout="wholebody313", fps=30)
    made = amass.features(tmp_path / "out")
    assert sorted(made) == [f"CMU/01/{n}" for n in ("h_poses", "parts_stageii", "still_poses", "x_stageii")]
    np.testing.assert_array_equal(made["CMU/01/h_poses"], made["CMU/01/x_stageii"])
    np.testing.assert_array_equal(made["CMU/01/h_poses"], made["CMU/01/parts_stageii"])
    layout = MotionLayout.named("wholebody313")
    joints = decode(made["CMU/01/h_poses"], layout)
    np.testing.assert_allclose(joints, amass.expected_joints(30.0, joints=52), atol=3e-4)
    assert amass.meta_of(tmp_path / "out", "CMU/01/h_poses")[0].has_hands
    assert not amass.meta_of(tmp_path / "out", "CMU/01/still_poses")[0].has_hands
    ((left_out, reason),) = amass.reasons(manifest).items()
    assert left_out == "CMU/01/body_poses.npz" and "wholebody313" in reason


def test_bones_come_from_the_body_model_of_the_gender(amass: ModuleType, tmp_path: Path) -> None:
    clip = amass.walk(60.0)
    betas = {"betas": np.array([2.0, 9.0])}  # the model has one shape value
    amass.save(tmp_path / "in/A/b/f_poses.npz", **(clip | betas))
    amass.save(tmp_path / "in/A/b/m_poses.npz", **(clip | betas | {"gender": np.array(b"male")}))
    amass.save(tmp_path / "in/A/b/n_poses.npz", **(clip | {"gender": np.array("unknown")}))
    amass.save(tmp_path / "in/A/b/x_stageii.npz", **amass.as_smplx(clip))
    models = {
        "body_model_female": amass.body_model(tmp_path / "models/female/model.npz", 52, 0.9),
        "body_model_male": amass.body_model(tmp_path / "models/male/model.npz", 52, 1.1),
    }
    manifest = amass.make(tmp_path / "in", tmp_path / "out", **models)
    made = amass.features(tmp_path / "out")
    own = amass.expected_joints(20.0)
    for clip_id, scale in (("A/b/f_poses", 1.0), ("A/b/m_poses", 1.2)):
        joints = decode(made[clip_id], MotionLayout.named("body133"))
        bone = np.linalg.norm(joints[:, 4] - joints[:, 1], axis=-1)
        np.testing.assert_allclose(bone, scale * np.linalg.norm(own[0, 4] - own[0, 1]), rtol=1e-4)
    left_out = amass.reasons(manifest)
    assert "gender 'neutral'" in left_out["A/b/n_poses.npz"]
    assert "body model is SMPL-H" in left_out["A/b/x_stageii.npz"]
    assert manifest.options["bodies"]["female"]["file"] == "model.npz"
    assert str(tmp_path) not in json.dumps(manifest.dump())
    whole = amass.body_model(tmp_path / "models/x.npz", 55, 1.0)
    manifest = amass.make(tmp_path / "in", tmp_path / "x", body_model=whole)
    assert manifest.options["bodies"]["neutral"]["kind"] == "SMPL-X"
    assert list(amass.features(tmp_path / "x")) == ["A/b/x_stageii"]


def test_plan_accounts_for_every_file(amass: ModuleType, tmp_path: Path) -> None:
    source = tmp_path / "in"
    clip = amass.walk(60.0)
    amass.save(source / "KIT/3/good_poses.npz", **clip)
    amass.save(source / "KIT/3/short_poses.npz", **amass.walk(60.0, seconds=0.5))
    amass.save(source / "CMU/01/01_01_poses.npz", **clip)
    amass.save(source / "CMU/01/shape.npz", betas=clip["betas"])
    amass.save(source / "CMU/01/neutral_stagei.npz", betas=clip["betas"])
    (source / "CMU/LICENSE.txt").write_text("terms")
    (source / "CMU/02").mkdir()
    (source / "CMU/02/cut_poses.npz").write_bytes((source / "CMU/01/01_01_poses.npz").read_bytes()[:-50])
    (source / "CMU/elsewhere").symlink_to(tmp_path)
    (source / "CMU/02/link_poses.npz").symlink_to(tmp_path / "outside.npz")
    amass.save(tmp_path / "outside.npz", **clip)
    plan = prepare(AmassConfig(source=source)).plan
    assert plan.totals.found == 6
    assert [clip.id for _, clip in plan.items] == ["CMU/01/01_01_poses", "KIT/3/good_poses"]
    assert [(d.source, d.reason[:6]) for d in plan.dropped] == [("KIT/3/short_poses.npz", "0.52 s")]
    broken = {d.source: d.reason for d in plan.broken}
    linked = ["CMU/02/link_poses.npz", "CMU/elsewhere/outside.npz"]
    assert sorted(broken) == ["CMU/02/cut_poses.npz", *linked]
    assert "cut off" in broken["CMU/02/cut_poses.npz"]
    assert all("leaves in/" in broken[name] for name in linked)
    assert plan.totals.licences == {"AMASS-noncommercial": 2}
    assert sum(plan.totals.frames.values()) == 2 * 61


class Boom:
    """A pickle that would make a file."""

    def __reduce__(self) -> Any:
        return (Path.touch, (Path("PWNED_amass"),))


BROKEN: list[tuple[dict[str, Any], str]] = [
    ({"poses": None}, "'poses', nor root_orient and pose_body"),
    ({"trans": None}, "'trans'"),
    ({"mocap_framerate": None}, "set source_fps"),
    ({"mocap_framerate": np.array(0.0)}, "state it: --set source_fps=120"),
    ({"mocap_frame_rate": np.array(90.0)}, "mocap_framerate 60 and mocap_frame_rate 90 differ"),
    ({"poses": np.zeros((181, 155))}, "poses is [T, 155]"),
    ({"poses": np.zeros((156,))}, "poses is [156]"),
    ({"poses": np.zeros((0, 156)), "trans": np.zeros((0, 3))}, "no frames"),
    ({"trans": np.zeros((180, 3))}, "180 frames of trans"),
    ({"betas": np.zeros((2, 3, 4))}, "betas is [2, 3, 4]"),
    ({"betas": np.arange(20.0).reshape(2, 10)}, "betas"),
    ({"poses": "nan"}, "poses: nan at frame 9, column 30"),
    ({"trans": "inf"}, "trans: inf at frame 9, column 1"),
    ({"poses": "huge"}, "1e+06 at frame 9, column 30; at most 100"),
    ({"trans": "jump"}, "moves at"),
    ({"gender": np.array([Boom()], dtype=object)}, "'gender': object array"),
]


@pytest.mark.parametrize(("change", "message"), BROKEN, ids=[message[:40] for _, message in BROKEN])
def test_broken_clips_are_left_out_with_their_reason(
    amass: ModuleType, change: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    bad: dict[str, Any] = amass.walk(60.0)
    for key, value in change.items():
        bad[key] = bad.get(key, np.zeros(1)).copy()
        if value is None:
            del bad[key]
        elif isinstance(value, str):
            column = 30 if key == "poses" else 1
            bad[key][9, column] = {"nan": math.nan, "inf": math.inf, "huge": 1e6, "jump": 50.0}[value]
        else:
            bad[key] = value
    amass.save(tmp_path / "in/A/b/good_poses.npz", **amass.walk(60.0))
    amass.save(tmp_path / "in/A/b/bad_poses.npz", **bad)
    manifest = amass.make(tmp_path / "in", tmp_path / "out")
    (reason,) = amass.reasons(manifest).values()
    assert message in reason and str(tmp_path) not in reason
    assert list(amass.features(tmp_path / "out")) == ["A/b/good_poses"]
    assert not (tmp_path / "PWNED_amass").exists()


def test_pickled_extras_do_not_matter(amass: ModuleType, tmp_path: Path) -> None:
    amass.save(tmp_path / "in/A/b/c_stageii.npz", markers_latent_vids=np.array({"a": 1}, dtype=object),
         **amass.as_smplx(amass.walk(60.0)))  # fmt: skip
    amass.make(tmp_path / "in", tmp_path / "out")
    assert list(amass.features(tmp_path / "out")) == ["A/b/c_stageii"]


def test_source_fps_and_up_override_the_file(amass: ModuleType, tmp_path: Path) -> None:
    clip = amass.walk(60.0)
    upright = clip["poses"].reshape(-1, 52, 3).copy()
    flat = Rotation.from_rotvec([-math.pi / 2, 0, 0])
    upright[:, 0] = (flat * Rotation.from_rotvec(upright[:, 0])).as_rotvec()
    changed = {"poses": upright.reshape(-1, 156), "trans": flat.apply(clip["trans"]),
               "mocap_framerate": np.array(30.0)}  # fmt: skip
    for number, stated in enumerate((30.0, 0.0, math.nan)):
        changed["mocap_framerate"] = np.array(stated)
        source, out = tmp_path / f"in{number}", tmp_path / f"out{number}"
        amass.save(source / "A/b/c_poses.npz", **(clip | changed))
        amass.make(source, out, up="y", source_fps=60)
        (motion,) = amass.features(out).values()
        joints = decode(motion, MotionLayout.named("body133"))
        np.testing.assert_allclose(joints, amass.expected_joints(20.0), atol=3e-4)


def test_captions_splits_and_missing_clips(amass: ModuleType, tmp_path: Path) -> None:
    source, captions = tmp_path / "in", tmp_path / "captions.jsonl"
    for name in ("a", "b", "c"):
        amass.save(source / f"KIT/3/{name}_poses.npz", **amass.walk(60.0))
    rows = [
        {"id": "first", "file": "KIT/3/a_poses.npz", "captions": ["walks to the left"]},
        {"id": "KIT/3/b_poses", "captions": ["walks"], "split": "val"},
        {"id": "gone", "file": "KIT/3/gone_poses.npz", "captions": ["sits"]},
    ]
    captions.write_text("\n".join(map(json.dumps, rows)))
    with pytest.raises(UserError, match=r"1 of 3.*\(KIT/3/c_poses\.npz\)"):
        amass.make(source, tmp_path / "out", captions=captions)
    plan = prepare(AmassConfig(source=source, captions=captions, uncaptioned="drop")).plan
    assert {clip.id: split for split, clip in plan.items} == {
        "first": hash_split("first"),
        "KIT/3/b_poses": "val",
    }
    assert [drop.source for drop in plan.missing] == ["KIT/3/gone_poses.npz"]
    assert [drop.reason for drop in plan.dropped] == ["no usable caption"]


def test_parameters_are_kept_for_ude(amass: ModuleType, tmp_path: Path) -> None:
    """`smpl75` poses the same joints, mirrored ones too; others than SMPL have hands at rest."""
    clip = amass.walk(60.0)
    amass.save(tmp_path / "in/KIT/3/walk_poses.npz", **clip)
    (tmp_path / "index.csv").write_text(
        "source_path,start_frame,end_frame,new_name\n./pose_data/KIT/3/walk_poses.npy,0,-1,000001.npy\n"
    )
    poses = np.concatenate([clip["poses"][:, :66], np.full((len(clip["poses"]), 6), 0.25)], axis=1)
    amass.save(tmp_path / "smpl/KIT/3/walk_poses.npz", **{**clip, "poses": poses})
    index = {"humanml_index": tmp_path / "index.csv", "mirror": True, "uncaptioned": "keep"}
    layout, wanted = MotionLayout.named("smpl75"), amass.expected_joints(20.0)
    for source, palms in (("in", 0.0), ("smpl", 0.25)):
        amass.make(tmp_path / source, tmp_path / f"{source}-out", layout="smpl75", **index)
        found = amass.features(tmp_path / f"{source}-out")
        joints = joints_of(found["000001"], layout)
        assert found["000001"].shape[1] == 75 and len(joints) >= 59
        np.testing.assert_allclose(joints, wanted[: len(joints)], atol=2e-3)
        other = joints_of(found["M000001"], layout)
        image = canonicalize(mirror(wanted, layout.skeleton))[: len(other)]
        np.testing.assert_allclose(other, image, atol=2e-3)
        np.testing.assert_allclose(found["000001"][:, 69:], palms, atol=1e-6)


def test_options_that_exclude_each_other(tmp_path: Path) -> None:
    for options, message in (
        ({"mirror": True}, "need humanml_index"),
        ({"humanml_index": "i.csv", "captions": "c.jsonl"}, "exclude each other"),
    ):
        with pytest.raises(UserError, match=message):
            AmassConfig.parse({"source": str(tmp_path), **options}, "options")
    with pytest.raises(UserError, match="layout smplx322 cannot be made"):
        prepare(AmassConfig(source=tmp_path, layout="smplx322"))
    with pytest.raises(UserError, match=r"no \.npz file"):
        prepare(AmassConfig(source=tmp_path))
    with pytest.raises(UserError, match="no such folder"):
        prepare(AmassConfig(source=tmp_path / "none"))


# AMASS conversion by HumanML3D's index: cuts, names, mirrored clips, captions, and broken indices.


@pytest.fixture
def humanml(amass: ModuleType, tmp_path: Path) -> Path:
    """An AMASS tree with an index and texts of HumanML3D's form."""
    source = tmp_path / "amass"
    amass.save(source / "KIT/3/walk_left_poses.npz", **amass.walk(100.0, seconds=6.0))
    amass.save(source / "HDM05/bk/HDM_bk 01_stageii.npz", **amass.as_smplx(amass.walk(120.0, seconds=8.0)))
    amass.save(source / "MoSh/50020/odd_poses.npz", **amass.walk(250.0, seconds=4.0))
    amass.save(source / "CMU/01/unused_poses.npz", **amass.walk(60.0))
    rows = [
        "./pose_data/KIT/3/walk_left_poses.npy,10,70,000000",
        "./pose_data/KIT/3/walk_left_poses.npy,0,1000,000001",
        "./pose_data/MPI_HDM05/bk/HDM_bk_01_poses.npy,10,60,000002",
        "./pose_data/MPI_mosh/50020/odd_poses.npy,0,60,000003",
        "./pose_data/humanact12/humanact12/P11G01.npy,0,-1,000004",
        "./pose_data/KIT/3/gone_poses.npy,0,50,000005",
        "./pose_data/KIT/3/walk_left_poses.npy,500,600,000006",
    ]
    lines = ["source_path,start_frame,end_frame,new_name", *(f"{row}.npy" for row in rows)]
    (tmp_path / "index.csv").write_text("\n".join(lines))
    texts = tmp_path / "texts"
    texts.mkdir()
    for number, text in (("000000", "turns left"), ("M000000", "turns right"), ("000001", "walks"),
                         ("000002", "walks"), ("000003", "walks")):  # fmt: skip
        whole = f"a person {text}#a/DET person/NOUN {text.split()[0]}/VERB#0.0#0.0\n"
        segment = "an arm rises#an/DET arm/NOUN rise/VERB#1.0#2.0\n"
        (texts / f"{number}.txt").write_text(whole + segment)
    return tmp_path


def test_humanml_index_cuts_names_mirrors_and_captions(amass: ModuleType, humanml: Path) -> None:
    options = {"humanml_index": humanml / "index.csv", "humanml_texts": humanml / "texts", "mirror": True}
    manifest = amass.make(humanml / "amass", humanml / "out", **options)
    made = amass.features(humanml / "out")
    assert sorted(made) == ["000000", "000001", "000002", "000003", "M000000"]
    layout = MotionLayout.named("body133")

    whole = amass.walk(100.0, seconds=6.0)
    body = BodyModel.neutral("smpl22")
    world = smpl_joints(whole["poses"].reshape(-1, 52, 3)[:, :22], whole["trans"], body)
    thinned = (world[..., [0, 2, 1]] * [1, 1, -1])[::5][10:70]  # what the published preparation keeps
    np.testing.assert_allclose(decode(made["000000"], layout), canonicalize(thinned), atol=1e-5)
    mirrored = canonicalize(mirror(thinned, layout.skeleton))
    np.testing.assert_allclose(decode(made["M000000"], layout), mirrored, atol=1e-5)

    meta, texts = amass.meta_of(humanml / "out", "M000000")
    assert meta.mirror_of == "000000" and meta.source == "KIT/3/walk_left_poses.npz"
    assert meta.split == amass.meta_of(humanml / "out", "000000")[0].split
    assert [(c.text, c.start, c.end) for c in texts] == [
        ("a person turns right", 0.0, None),
        ("an arm rises", 1.0, 2.0),
    ]
    assert texts[0].tokens == ["a/DET", "person/NOUN", "turns/VERB"]
    assert len(made["000001"]) == 121  # an end beyond the file is the file's
    late = amass.expected_joints(20.0, seconds=8.0)[70:120]  # HDM05's first three seconds are not counted
    np.testing.assert_allclose(decode(made["000002"], layout), canonicalize(late), atol=1e-5)
    wanted = {
        "humanact12/humanact12/P11G01.npy": "clip '000004' is listed",
        "KIT/3/gone_poses.npy": "clip '000005' is listed",
        "CMU/01/unused_poses.npz": "in no row",
        "KIT/3/walk_left_poses.npz (000006)": "601 frames",
        "KIT/3/walk_left_poses.npz (M000006)": "601 frames",
        "KIT/3/walk_left_poses.npz (M000001)": "no usable caption",
        "HDM05/bk/HDM_bk 01_stageii.npz (M000002)": "no usable caption",
        "MoSh/50020/odd_poses.npz (M000003)": "no usable caption",
    }
    found = amass.reasons(manifest)
    assert found.keys() == wanted.keys() and all(part in found[file] for file, part in wanted.items())


def test_humanml_index_at_250_frames_a_second_is_thinned_to_20_83(amass: ModuleType, humanml: Path) -> None:
    """60 frames of the index are 59 * 12 steps of 1/250 s = 2.832 s, and its texts are as much shorter."""
    options = {"humanml_index": humanml / "index.csv", "humanml_texts": humanml / "texts"}
    amass.make(humanml / "amass", humanml / "out", **options)
    motion = amass.features(humanml / "out")["000003"]
    assert len(motion) == int(2.832 * 20) + 1
    _, texts = amass.meta_of(humanml / "out", "000003")
    assert (texts[1].start, texts[1].end) == (pytest.approx(0.96), pytest.approx(1.92))
    assert texts[0].end is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("path,start\n", r"no column 'source_path'"),
        ("{head}./pose_data/A/b/c.npy,0,9\n", r":2: 3 columns"),
        ("{head}./pose_data/A/b/c.npy,x,9,000000.npy\n", r":2: start_frame: 'x' is no number"),
        ("{head}./pose_data/A/b/c.npy,-3,9,000000.npy\n", r":2: start_frame: '-3' is no number"),
        ("{head}./pose_data/../../x.npy,0,9,000000.npy\n", r":2: clip id .* is not a plain relative name"),
        ("{head}a/b/c.npy,0,9,../../x.npy\n", r":2: clip id .* is not a plain relative name"),
        ("{head}a/b/c.npy,0,9,1.npy\na/b/c.npy,0,9,1.npy\n", r":3: clip '1' has a row already"),
    ],
)
def test_bad_rows_of_an_index_are_left_out(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "index.csv"
    path.write_text(text.replace("{head}", "source_path,start_frame,end_frame,new_name\n"))
    bad: dict[str, str] = {}
    try:
        kept = len(read_index(path, bad))
        said = "\n".join(bad.values())
        assert list(bad) == [said.partition(": ")[0]] and kept == text.count(",1.npy") // 2
    except UserError as error:
        said = str(error)
    assert re.search(message, said) and "index.csv" in said


def test_keys_join_the_releases() -> None:
    assert clip_key("ACCAD/Female1General_c3d/A1 - Stand_poses.npz") == clip_key(
        "SMPLX/ACCAD/Female1General_c3d/A1_-_Stand_stageii.npz"
    )
    assert clip_key("BMLrub/rub001/x_stageii.npz") == clip_key("BioMotionLab_NTroje/rub001/x_poses.npy")
    row = IndexRow("1", "TotalCapture/s1/walk_poses.npy", 5, 10)
    assert row.cut(1000, 60.0) == (75, 88)
    assert IndexRow("1", "CMU/a/b.npy", 0, -1).cut(61, 60.0) == (0, 58)
    assert row.cut(60, 60.0) == (0, 0)
