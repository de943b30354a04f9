"""BVH files without fingers in layouts with hands: at rest or masked, on bodies that stay as they are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bvh_clips import write_clip, write_map

from motionloom.datasets.convert.bvh.convert import BvhConfig, prepare_bvh
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.motion.features import decode
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.resting_hands import with_resting_hands
from motionloom.datasets.schema import Manifest, UserError
from motionloom.datasets.shards.reader import ShardDataset


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clips")
    write_clip(folder / "sway.bvh", 1)
    return folder


def convert(clips: Path, out: Path, **changes: Any) -> Manifest:
    given: dict[str, Any] = {"source": clips, "licence": "CC0-1.0", "look": 0, **changes}
    prepared = prepare_bvh(BvhConfig(**given))
    return run_conversion(prepared, out, workers=1, progress=False)


@pytest.mark.parametrize("fingers", ["resting", "missing"])
def test_hands_are_added_and_the_body_stays(clips: Path, tmp_path: Path, fingers: str) -> None:
    manifest = convert(clips, tmp_path / "whole", layout="wholebody363", fingers=fingers)
    convert(clips, tmp_path / "body")
    (shard,) = (one for one in manifest.shards if one.samples)
    whole, body = (ShardDataset.open(tmp_path / name, shard.split) for name in ("whole", "body"))
    layout = MotionLayout.named("wholebody363", fps=20.0)
    assert whole.layout == layout
    assert whole.meta(0).has_hands is (fingers == "resting") and not whole.meta(0).has_face
    motion = np.array(whole.motion(0))
    np.testing.assert_allclose(motion[:, layout.part("body")], np.array(body.motion(0)), atol=1e-5)
    assert not motion[:, layout.slice("face")].any()
    joints = decode(motion, layout)
    # Made at 30 fps and resampled along straight lines: close, not equal.
    np.testing.assert_allclose(joints, with_resting_hands(joints[:, :22]), atol=0.01)


def test_shards_of_recorded_fingers_are_those_of_before(clips: Path) -> None:
    """An option that is not used leaves no trace, so shards from before there was one stay valid."""
    config = BvhConfig(source=clips, licence="CC0-1.0")
    assert "fingers" not in config.options()
    assert BvhConfig(source=clips, licence="CC0-1.0", fingers="resting").options()["fingers"] == "resting"


def test_a_map_without_fingers_is_refused_where_fingers_are_recorded(clips: Path, tmp_path: Path) -> None:
    path = write_map(tmp_path / "map.json")
    with pytest.raises(UserError, match="'smplx52'; found smpl22"):
        convert(clips, tmp_path / "out", layout="wholebody313", joint_map=path)
    convert(clips, tmp_path / "out", layout="wholebody313", joint_map=path, fingers="resting")
