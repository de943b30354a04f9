"""Layouts: the columns without the face are a layout of their own."""

from __future__ import annotations

import numpy as np
import pytest

from motionloom.datasets.motion.layout import LAYOUTS, MotionLayout
from motionloom.datasets.schema import UserError


@pytest.mark.parametrize("name", LAYOUTS)
def test_without_face_is_the_layout_of_the_body_and_hand_columns(name: str) -> None:
    layout = MotionLayout.named(name, fps=12.5)
    if layout.family == "raw" and layout.has("face"):
        with pytest.raises(UserError, match="no counterpart without the face"):
            layout.without_face()
        return
    bare, columns = layout.without_face(), layout.part("bodyhand")
    assert (bare.dim, bare.fps, bare.family) == (len(columns), 12.5, layout.family)
    assert bare.skeleton_name == layout.skeleton_name and not bare.has("face")
    numbers = np.arange(layout.dim)
    for field, _ in bare.fields:  # the same columns under the same name
        np.testing.assert_array_equal(numbers[columns][bare.slice(field)], numbers[layout.slice(field)])
    assert (bare is layout) == (not layout.has("face"))
