"""HumanML3D's clips cut from the free originals, against cuts by hand."""

from __future__ import annotations

import random
import shutil
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from amass_clips import features, meta_of, reasons
from bvh_clips import SKELETON, write_clip, write_map
from numpy.typing import NDArray
from typer.testing import CliRunner

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import REMOVED_FILE, Decisions, Manifest, Split
from motionloom.datasets.check.dataset import check
from motionloom.datasets.convert.bvh.config import BvhConfig
from motionloom.datasets.convert.captions.humanml_index import ORIGINALS, IndexRow
from motionloom.datasets.convert.common import removed
from motionloom.datasets.convert.common.conversion import Conversion, run_conversion
from motionloom.datasets.convert.common.removed import Removed, remove
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.motion.bvh.asf import read_amc
from motionloom.datasets.motion.bvh.motion import read_bvh
from motionloom.datasets.motion.canonical import canonicalize, mirror, resample
from motionloom.datasets.motion.features.codec import decode
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards import finish, tasks
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.pipeline.cli.main import app

FILES = {
    "cmu/133/133_24.bvh": (120.0, 10.0),
    "cmu/60/60_01.bvh": (120.0, 5.0),  # captured at 60: ten seconds
    "cmu/18/18_11.bvh": (120.0, 10.0),
    "mocapdata/hamada/accident-12-twist foot-hamada.bvh": (60.0, 10.0),
    "ACCAD/Female1General_bvh/A1 - Stand.bvh": (30.0, 4.0),
    "hdm05/HDM_bd_02-01_01_120.bvh": (120.0, 9.0),
    "stray.bvh": (30.0, 4.0),
}
"""Names as the originals have them, with the rate in the header, and seconds by it."""
ROWS = """CMU/133/133_24_poses,20,120,000010
CMU/133/133_24_poses,100,200,000011
CMU/60/60_01_poses,40,180,000012
CMU/18_19_rory/18_11_poses,0,60,000013
CMU/01/01_01_poses,0,60,000014
Eyes_Japan_Dataset/hamada/accident-12-twist foot-hamada_poses,10,130,000020
ACCAD/Female1General_c3d/A1 - Stand_poses,0,80,000030
MPI_HDM05/bd/HDM_bd_02-01_01_120_poses,20,100,000040
KIT/3/walk_poses,0,60,000050"""
SECONDS = {  # by hand: frames are twentieths, counted after 3 s in two of the collections
    "000010": (1.0, 5.95), "000011": (5.0, 9.95), "000012": (2.0, 8.95), "000020": (3.5, 9.45),
    "000030": (0.0, 3.95), "000040": (4.0, 7.95),
}  # fmt: skip
LAYOUT = MotionLayout.named("body133", fps=20.0)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Originals, HumanML3D's index, texts and split files."""
    for number, (name, (fps, seconds)) in enumerate(FILES.items()):
        path = tmp_path / "mocap" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_clip(path, number, round(fps * seconds) + 1, fps)
    write_map(tmp_path / "map.json")
    write_index(tmp_path, ROWS.splitlines())
    (tmp_path / "texts").mkdir()
    for clip_id in SECONDS:
        for side, prefix in (("left", ""), ("right", "M")):
            lines = f"a person waves the {side} arm#a/DET arm/NOUN#0.0#0.0\nand stands#stand/VERB#1.0#nan\n"
            lines = lines.replace("1.0#nan", "1.0#1.0") + "it ends#end/VERB#nan#2.0\n"
            (tmp_path / "texts" / f"{prefix}{clip_id}.txt").write_text(lines)
    named = [f"{prefix}{clip_id}" for clip_id in SECONDS for prefix in ("", "M")]
    (tmp_path / "train.txt").write_text("\n".join(name for name in named if not name.endswith("11")))
    (tmp_path / "test.txt").write_text("000011\nM000011\n")
    return tmp_path


def write_index(folder: Path, rows: list[str]) -> None:
    lines = [f"./pose_data/{row.replace('_poses,', '_poses.npy,')}.npy" for row in rows]
    (folder / "index.csv").write_text("\n".join(["source_path,start_frame,end_frame,new_name", *lines]))


def planned(tree: Path, **options: Any) -> Conversion[Any]:
    given = {"joint_map": tree / "map.json", "unit": "cm", "up": "y", "humanml_texts": tree / "texts"}
    given |= {"source": tree / "mocap", "humanml_index": tree / "index.csv", "mirror": True}
    return prepare(BvhConfig(**(given | options)))


def by_hand(path: Path, fps: float, seconds: tuple[float, float]) -> NDArray[np.float64]:
    """Joints [T, 22, 3] in metres between two times, both included."""
    motion = read_bvh(path)
    frames = motion.positions()[round(seconds[0] * fps) : round(seconds[1] * fps) + 1]
    return frames[:, [motion.joints.index(joint) for joint in SKELETON.joints]] / 100


def test_clips_are_cut_named_split_and_mirrored(tree: Path) -> None:
    conversion = planned(tree)
    manifest = run_conversion(conversion, tree / "out", progress=False)
    made, wanted = features(tree / "out"), [clip_id for clip_id in SECONDS if clip_id != "000040"]
    assert sorted(made) == sorted(f"{side}{clip_id}" for clip_id in wanted for side in ("", "M"))
    places = dict(zip(SECONDS, [*FILES][:1] + [*FILES][:2] + [*FILES][3:], strict=False))
    read = {clip.id: clip for _, clip in conversion.plan.items}
    for clip_id in wanted:
        place, fps = places[clip_id], 60.0 if clip_id == "000012" else FILES[places[clip_id]][0]
        joints = by_hand(tree / "mocap" / place, fps, SECONDS[clip_id])
        found = conversion.converter.joints(read[clip_id])
        np.testing.assert_allclose(found.joints, joints, atol=1e-6, rtol=0)
        assert found.fps == pytest.approx(fps, rel=1e-5)
        for side, shown in (("", joints), ("M", mirror(joints, LAYOUT.skeleton))):
            expected = canonicalize(resample(shown, fps, 20.0))
            got = decode(made[f"{side}{clip_id}"], LAYOUT)
            assert abs(len(got) - len(expected)) <= 1  # the header rounds the length of a frame
            np.testing.assert_allclose(got, expected[: len(got)], atol=2e-5)
        meta, texts = meta_of(tree / "out", f"M{clip_id}")
        assert meta.mirror_of == clip_id and meta.split == ("test" if clip_id == "000011" else "train")
        assert meta.licence == ORIGINALS[{"1": "CMU", "2": "Eyes_Japan_Dataset", "3": "ACCAD"}[clip_id[4]]]
        spans = [(text.text, text.start, text.end) for text in texts]
        assert spans == [
            ("a person waves the right arm", 0, None), ("and stands", 0, None), ("it ends", 0, 2)
        ]  # fmt: skip
    left = reasons(manifest)
    assert "two people" in left["CMU/18_19_rory/18_11_poses.npy"]
    assert "not in the source" in left["CMU/01/01_01_poses.npy"] and "no row" in left["stray.bvh"]
    assert not any("KIT" in name for name in left)
    assert manifest.licence == "CC-BY-2.1-JP AND CC-BY-3.0"
    assert manifest.licences == {"CC-BY-2.1-JP": 2, "CC-BY-3.0": 2, "CMU-mocap": 6}


def test_share_alike_is_a_set_of_its_own(tree: Path) -> None:
    plan = planned(tree).plan
    assert any(note.startswith("MPI_HDM05: 1 clips") and "CC-BY-SA-3.0" in note for note in plan.notes)
    conversion = planned(tree, licence="CC-BY-SA-3.0")
    plan, path = conversion.plan, tree / "mocap" / [*FILES][5]
    assert [clip.id for _, clip in plan.items] == ["000040", "M000040"]
    assert plan.totals.licences == {"CC-BY-SA-3.0": 2}
    found = conversion.converter.joints(plan.items[0][1]).joints
    np.testing.assert_allclose(found, by_hand(path, 120.0, SECONDS["000040"]), atol=1e-6, rtol=0)
    with pytest.raises(UserError, match="CC-BY-SA-3"):
        planned(tree, licence="unknown")


def test_names_and_lengths_that_do_not_agree_stop(tree: Path) -> None:
    rows = [*ROWS.splitlines(), "CMU/133/133_24_poses,100,206,000015"]
    write_index(tree, rows)
    assert "2 clips" in planned(tree).plan.stop  # and the mirrored one
    with pytest.raises(UserError, match=r"133_24\.bvh \(000015\): .* 0\.25 s"):
        run_conversion(planned(tree), tree / "out", progress=False)
    assert not (tree / "out").exists()
    left = planned(tree, uncaptioned="drop").plan
    assert not left.stop and "000015" not in {clip.id for _, clip in left.items}
    (tree / "texts/000010.txt").unlink()
    write_index(tree, ROWS.splitlines())
    assert "no words for 1 of" in planned(tree).plan.stop


def test_originals_and_amass_are_cut_alike() -> None:
    """Where AMASS's rate is a multiple of 20 both ways of counting give the same frames."""
    random = np.random.default_rng(0)
    for _ in range(2000):
        subset = str(random.choice(["CMU", "Eyes_Japan_Dataset", "MPI_HDM05", "ACCAD", "TotalCapture"]))
        fps, start = float(random.choice([20, 60, 100, 120, 200])), int(random.integers(0, 90))
        row = IndexRow("1", f"{subset}/a/b.npy", start, start + int(random.integers(-1, 120)))
        frames = int(random.integers(1, 1500))
        first, last, problem = row.span(frames, fps)
        if not problem:
            assert (first, last) == row.cut(frames, fps)
        elif row.end > row.start and "after the" in problem:
            assert row.cut(frames, fps)[1] <= frames  # AMASS's own files are cut short instead
        else:
            assert row.cut(frames, fps) == (0, 0)


def test_real_trials_of_cmu(shared: Path, tmp_path: Path) -> None:
    """The public AMC and BVH files of two trials: the same clip from both, and AMC's frames by hand."""
    with tarfile.open(shared / "data/real/cmu/amc.tar.xz") as archive:
        for name in ("amc/01.asf", "amc/01_01.amc"):
            archive.extract(name, tmp_path, filter="data")
    with tarfile.open(shared / "data/real/cmu/bvh_mb.tar.xz") as archive:
        archive.extract("bvh_mb/01_01.bvh", tmp_path, filter="data")
    write_index(tmp_path, ["CMU/01/01_01_poses,50,250,002510"])
    clips = {}
    for kind in ("amc", "bvh_mb"):
        config = BvhConfig(source=tmp_path / kind, humanml_index=tmp_path / "index.csv", uncaptioned="keep")
        conversion = prepare(config)
        [(_, clip)] = conversion.plan.items
        clips[kind] = conversion.converter.joints(clip).joints
        assert len(clips[kind]) == 199 * 6 + 1
    asf, amc = ((tmp_path / "amc" / name).read_bytes() for name in ("01.asf", "01_01.amc"))
    whole = read_amc(asf, amc, name="01_01")
    hips = whole.values[300 : 300 + 1195, :3] / 100
    np.testing.assert_allclose(clips["amc"][:, 0], hips, atol=1e-6, rtol=0)
    apart = [motion - motion[:1, :1] for motion in clips.values()]
    assert np.abs(apart[0][:, 0] - apart[1][:, 0]).max() < 0.02  # two writers' skeletons, the same way
    necks = [
        np.linalg.norm(one[:, 15] - one[:, 12], axis=-1).mean() for one in apart
    ]  # both above the collars
    assert abs(necks[0] - necks[1]) < 0.02


# Clips taken out of a data set for good: no name is left, others are untouched, killed and made again.

PEOPLE = ("anna", "bert", "carla", "dora")
SPLITS: tuple[Split, ...] = ("train", "val", "test")


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    for seed in range(20):
        path = folder / PEOPLE[seed % 4] / f"take{seed:02}.bvh"
        path.parent.mkdir(exist_ok=True)
        write_clip(path, seed, frames=36)
    (folder / "anna/short.bvh").write_text((folder / "anna/take00.bvh").read_text()[:-400])
    write_map(folder / "map.json")
    return folder


def convert(source: Path, out: Path) -> tuple[Manifest, list[str]]:
    said: list[str] = []
    config = BvhConfig(source=source, joint_map=source / "map.json", licence="CC0", splits=Path("clips:3"))
    prepared = prepare(config, out=out)
    manifest = run_conversion(prepared, out, clips_per_shard=4, progress=False, say=said.append)
    return manifest, [*prepared.plan.notes, *said]


@pytest.fixture(scope="module")
def made(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "out"
    convert(source, out)
    return out


def clips_in(out: Path) -> dict[str, NDArray[np.float32]]:
    held = {shard.split for shard in Manifest.load_json(out / "manifest.json").shards}
    found = {}
    for split in held:
        dataset = ShardDataset.open(out, split)
        found |= {name: np.array(dataset.motion(clip)) for clip, name in enumerate(dataset.ids)}
    return found


def content(folder: Path) -> dict[str, bytes]:
    """Files of a set without the record, whose salt is random, and what converters remember."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in files if path.name != REMOVED_FILE
    }


def test_a_person_leaves(source: Path, made: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(made, tmp_path / "out"))
    (out / "report.html").write_text("anna")
    (out / "cleaned.json").write_text(
        '{"left_out": {"anna/take00": "odd"}, "kept": ["anna/take04", "bert/take01"]}'
    )
    before, everyone = {path: path.stat().st_mtime_ns for path in out.glob("*.tar")}, clips_in(made)
    held = {path for path in before if b"anna/" in path.read_bytes()}
    assert 0 < len(held) < len(before)
    ran = CliRunner().invoke(app, ["data", "remove", str(out), "--subject", "anna"])
    assert ran.exit_code == 0 and f"5 clips removed; {len(held)} shards written" in ran.output
    assert {path for path in before if not path.exists() or path.stat().st_mtime_ns != before[path]} == held
    assert not [name for name, data in content(out).items() if b"anna" in data], "nobody is named"
    assert Decisions.of(out).kept == ("bert/take01",)
    left = clips_in(out)
    assert left.keys() == {name for name in everyone if "anna" not in name} and not check(out)
    for name, motion in left.items():
        np.testing.assert_array_equal(motion, everyone[name])
    assert sum(Manifest.load_json(out / "manifest.json").licences.values()) == 21 - 5  # of planned clips
    shards = {path: path.read_bytes() for path in out.glob("*.tar")}
    _, said = convert(source, out)
    assert any("6 clips stay out" in line for line in said), "one of them could not be converted"
    assert shards == {path: path.read_bytes() for path in out.glob("*.tar")}
    assert clips_in(out).keys() == left.keys() and not check(out)
    shutil.copytree(source, tmp_path / "moved")
    (tmp_path / "moved/anna/take00.bvh").rename(tmp_path / "moved/anna/other.bvh")
    assert len(clips_in(out)) == 15 and convert(tmp_path / "moved", out)
    assert clips_in(out).keys() == left.keys(), "the subject stays out, not its files alone"
    (out / REMOVED_FILE).unlink()
    convert(source, out)
    assert content(out).keys() >= content(made).keys() and clips_in(out).keys() == everyone.keys()


def test_single_clips_and_their_mirror_images(source: Path, made: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(made, tmp_path / "out"))
    for wrong, said in (({"ids": ["bert/tak01"]}, "bert/take01"), ({"subjects": ["bart"]}, "'bert'")):
        with pytest.raises(UserError, match=said):
            remove(out, **wrong)
    with pytest.raises(UserError, match="--subject NAME or --id ID"):
        remove(out)
    with pytest.raises(UserError, match="nothing would be left"):
        remove(out, subjects=PEOPLE)
    assert content(out) == content(made)
    assert remove(out, ids=["bert/take01"]).clips == 1
    shards = {path: path.stat().st_mtime_ns for path in out.glob("*.tar")}
    _, said = convert(source, out)
    assert any("nothing to convert" in line for line in said)
    assert shards == {path: path.stat().st_mtime_ns for path in out.glob("*.tar")}, "every shard is kept"
    assert remove(out, ids=["bert/take01", "dora/take03"], subjects=["carla"]).clips == 6
    assert len(clips_in(out)) == 13 and not check(out)
    record = Removed.of(out)
    assert record.has("Mx", "dora/take03.bvh") and not record.has("dora/take07", "dora/take07.bvh")
    assert Removed(salt="x").and_more(["id h/007"]).has("h/M007", "h/M007.npy")


@pytest.mark.parametrize("seed", range(4))
def test_a_damaged_shard_is_not_written_again(seed: int, made: Path, tmp_path: Path) -> None:
    draw, out = random.Random(seed), Path(shutil.copytree(made, tmp_path / "out"))
    held = [path for path in sorted(out.glob("*.tar")) if b"anna/" in path.read_bytes()]
    damaged = draw.choice(held)
    raw = bytearray(damaged.read_bytes())
    raw[draw.randrange(len(raw))] ^= 1 << draw.randrange(8)
    damaged.write_bytes(raw)
    before = content(out)
    with pytest.raises(UserError, match=rf"{damaged.name}: .*sha256"):
        remove(out, subjects=["anna"])
    assert content(out) == before and not (out / REMOVED_FILE).exists()


class KilledError(BaseException):
    """Stands for a kill."""


@pytest.mark.parametrize("seed", range(12))
def test_killed_anywhere_it_is_given_again(
    seed: int, source: Path, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At any step that changes the folder; then the same command, or a conversion, ends as it would have."""
    draw = random.Random(seed)
    given: dict[str, Any] = {"subjects": draw.sample(PEOPLE, draw.randint(1, 2)), "ids": ["dora/take03"]}
    expected, out = Path(shutil.copytree(made, tmp_path / "a")), Path(shutil.copytree(made, tmp_path / "b"))
    remove(expected, **given)
    steps = 0

    def counted(function: Any, stop: int) -> Any:
        def call(*args: Any, **options: Any) -> Any:
            nonlocal steps
            steps += 1
            if steps == stop:
                raise KilledError
            return function(*args, **options)

        return call

    patches: list[tuple[Any, str]] = [(Path, "replace"), (Path, "unlink"), (shutil, "rmtree")]
    patches += [(place, "write_json") for place in (removed, finish, tasks)] + [(removed, "write_shard")]
    for _ in range(4):
        with monkeypatch.context() as patched, pytest.raises(KilledError):
            steps, stop = 0, draw.randint(1, 25)
            for place, name in patches:
                patched.setattr(place, name, counted(getattr(place, name), stop))
            remove(out, **given)
            raise KilledError
        if (out / "manifest.json").exists():
            assert clips_in(out).keys() in (clips_in(made).keys(), clips_in(expected).keys()) and not check(
                out
            )
    if draw.random() < 0.5:
        remove(out, **given)
        assert content(out) == content(expected)
    else:
        convert(source, out)
        remove(out, **given)
    assert clips_in(out).keys() == clips_in(expected).keys() and not check(out)
    assert not (out / ".old").exists()
