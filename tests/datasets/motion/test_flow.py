"""Joints of chunks: the same bits as those of the whole motion."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from motionloom.datasets.motion.flow import JointFlow
from motionloom.datasets.motion.joints import joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError

LAYOUTS = [
    MotionLayout.named("body133"),
    MotionLayout.named("wholebody363"),
    MotionLayout.named("wholebody363", family="h3d"),
    MotionLayout.named("h3d263"),
    MotionLayout.named("smpl75"),
]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: f"{layout.name} {layout.family}")
def test_chunks_are_the_whole_to_the_bit(layout: MotionLayout, dtype: type) -> None:
    features = np.random.default_rng(0).normal(size=(61, layout.dim)).astype(dtype)
    cuts = [0, 1, 2, 9, 9, 30, 60, 61]
    flow = JointFlow(layout)
    made = [flow(features[a:b]) for a, b in pairwise(cuts)]
    np.testing.assert_array_equal(np.concatenate(made), joints_of(features, layout))


def test_columns_of_body_and_hands_alone() -> None:
    layout = MotionLayout.named("wholebody363")
    features = np.random.default_rng(1).normal(size=(20, layout.dim)).astype(np.float32)
    body = features[:, layout.part("bodyhand")]
    flow = JointFlow(layout)
    np.testing.assert_array_equal(np.concatenate([flow(body[:7]), flow(body[7:])]), joints_of(body, layout))
    with pytest.raises(UserError, match="363 columns"):
        flow(features[:, :5])
