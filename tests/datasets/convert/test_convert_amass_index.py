"""AMASS conversion by HumanML3D's index: cuts, names, mirrored clips, captions, and broken indices."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from motionloom.datasets.convert.captions.humanml_index import IndexRow, clip_key, read_index
from motionloom.datasets.motion.body.smpl import BodyModel, smpl_joints
from motionloom.datasets.motion.canonical import canonicalize, mirror
from motionloom.datasets.motion.features.codec import decode
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError


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
def test_broken_indices_are_refused(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "index.csv"
    path.write_text(text.replace("{head}", "source_path,start_frame,end_frame,new_name\n"))
    with pytest.raises(UserError, match=message) as caught:
        read_index(path)
    assert "index.csv" in str(caught.value)


def test_keys_join_the_releases() -> None:
    assert clip_key("ACCAD/Female1General_c3d/A1 - Stand_poses.npz") == clip_key(
        "SMPLX/ACCAD/Female1General_c3d/A1_-_Stand_stageii.npz"
    )
    assert clip_key("BMLrub/rub001/x_stageii.npz") == clip_key("BioMotionLab_NTroje/rub001/x_poses.npy")
    row = IndexRow("1", "TotalCapture/s1/walk_poses.npy", 5, 10)
    assert row.cut(1000, 60.0) == (75, 88)
    assert IndexRow("1", "CMU/a/b.npy", 0, -1).cut(61, 60.0) == (0, 58)
    assert row.cut(60, 60.0) == (0, 0)
