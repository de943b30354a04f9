"""ASF/AMC trials through the BVH converter: loose and in an archive, with and without their skeleton."""

from __future__ import annotations

import tarfile
from pathlib import Path

import numpy as np
import pytest

from motionloom.datasets.convert.bvh.convert import BvhConfig
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.schema import Manifest
from motionloom.datasets.shards.reader import ShardDataset, load_manifest

TRIALS = ("HDM_bd_squat1Reps_012_120.amc", "HDM_bd_depositFloorR_001_120.amc")


@pytest.fixture(scope="module")
def trials(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two trials of one actor, and a third whose skeleton is not there."""
    folder = tmp_path_factory.mktemp("trials")
    with tarfile.open(shared / "data/real/hdm05/hdm05.tar.xz", "r|*") as archive:
        for member in archive:
            name = Path(member.name).name
            file = archive.extractfile(member) if name in (*TRIALS, "HDM_bd.asf") else None
            if file is not None:
                (folder / name).write_bytes(file.read())
    (folder / "HDM_xx_walk.amc").write_bytes((folder / TRIALS[0]).read_bytes())
    return folder


def convert(source: Path, out: Path) -> Manifest:
    prepared = prepare(BvhConfig(source=source, licence="CC-BY-SA-3.0"), out=out)
    return run_conversion(prepared, out, progress=False)


def motions(shards: Path) -> dict[str, np.ndarray]:
    manifest = load_manifest(shards)
    datasets = [ShardDataset.open(shards, split) for split in {shard.split for shard in manifest.shards}]
    return {clip: data.motion(row) for data in datasets for row, clip in enumerate(data.ids)}


def test_trials_are_converted_by_the_skeleton_of_their_subject(trials: Path, tmp_path: Path) -> None:
    manifest = convert(trials, tmp_path / "loose")
    assert sum(shard.samples for shard in manifest.shards) == 2
    left_out = (tmp_path / "loose" / "left-out.txt").read_text("utf-8")
    assert "HDM_xx_walk.amc" in left_out and "HDM_xx.asf" in left_out

    with tarfile.open(tmp_path / "trials.tar.xz", "w:xz") as archive:
        for path in sorted(trials.iterdir(), reverse=True):  # skeletons behind the motions
            archive.add(path, path.name)
    convert(tmp_path / "trials.tar.xz", tmp_path / "packed")
    loose, packed = motions(tmp_path / "loose"), motions(tmp_path / "packed")
    assert loose.keys() == packed.keys() and len(loose) == 2
    for clip, motion in loose.items():
        np.testing.assert_array_equal(motion, packed[clip])
