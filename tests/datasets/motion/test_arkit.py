"""ARKit weights against scipy's bounded least squares, and bases that are refused."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from motionloom.datasets.motion.body.arkit import ARKIT, ArkitBases, bounded_least_squares, write_arkit_csv
from motionloom.datasets.motion.body.live_link import read_face, write_face
from motionloom.datasets.schema import UserError


def test_bounded_least_squares_is_scipys() -> None:
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(60, 12))
    targets = rng.normal(size=(5, 60)) * 2
    found = bounded_least_squares(matrix.T @ matrix, targets @ matrix)
    for row, target in zip(found, targets, strict=True):
        reference = lsq_linear(matrix, target, bounds=(0, 1), tol=1e-14).x
        np.testing.assert_allclose(row, reference, atol=1e-4)


def test_weights_come_back_where_the_source_is_a_mixture_of_arkits_shapes() -> None:
    rng = np.random.default_rng(1)
    arkit = rng.normal(size=(52, 80, 3))
    mixture = rng.normal(size=(6, 52)) ** 2
    bases = ArkitBases(np.einsum("km,mvc->kvc", mixture, arkit), arkit)
    values = 0.04 * rng.uniform(size=(7, 6))
    weights = bases.weights(values)
    expected = values @ mixture
    inside = expected.max(axis=1) < 1
    assert inside.sum() >= 3
    np.testing.assert_allclose(weights[inside], expected[inside], atol=2e-3)
    assert (weights >= 0).all() and (weights <= 1).all()


def test_shapes_that_move_nothing_stay_at_rest() -> None:
    arkit = np.zeros((52, 10, 3))
    arkit[3, :, 1] = 1.0
    weights = ArkitBases(0.5 * arkit[3:4], arkit).weights(np.ones((2, 1)))
    assert weights[:, 3] == pytest.approx(0.5, abs=1e-4)
    assert np.delete(weights, 3, axis=1).max() == 0


def test_bases_are_read_and_wrong_ones_refused(tmp_path: Path) -> None:
    path = tmp_path / "bases.npz"
    np.savez(path, source=np.ones((50, 4, 3), np.float32), arkit=np.ones((52, 4, 3), np.float32))
    assert ArkitBases.read(path).weights(np.zeros((3, 50))).shape == (3, 52)
    with pytest.raises(UserError, match="50 values"):
        ArkitBases.read(path).weights(np.zeros((3, 49)))
    np.savez(path, source=np.ones((50, 4, 3)), arkit=np.ones((51, 4, 3)))
    with pytest.raises(UserError, match=r"\[52, V, 3\]"):
        ArkitBases.read(path)
    np.savez(path, source=np.ones((50, 5, 3)), arkit=np.ones((52, 4, 3)))
    with pytest.raises(UserError, match="same"):
        ArkitBases.read(path)
    np.savez(path, source=np.full((50, 4, 3), np.nan), arkit=np.ones((52, 4, 3)))
    with pytest.raises(UserError, match="NaN"):
        ArkitBases.read(path)


def test_expressions_come_back_from_their_weights() -> None:
    rng = np.random.default_rng(2)
    arkit = rng.normal(size=(52, 80, 3))
    bases = ArkitBases(np.einsum("km,mvc->kvc", rng.uniform(size=(6, 52)), arkit), arkit)
    values = 0.1 * rng.uniform(size=(7, 6))
    np.testing.assert_allclose(bases.expressions(bases.weights(values)), values, atol=1e-3)
    with pytest.raises(UserError, match=r"\[T, 52\]"):
        bases.expressions(values)


def take_text(frames: int = 5, **changes: str) -> str:
    names = ["Timecode", "BlendshapeCount", *(n[0].upper() + n[1:] for n in ARKIT), "HeadYaw", "LeftEyeYaw"]
    rows = [[f"10:00:59:{56 + 2 * f:06.3f}" if f < 2 else f"10:01:00:{2 * f - 4:06.3f}", "61",
             *["0.25"] * 52, "-0.5", "0.1"] for f in range(frames)]  # fmt: skip
    text = "\n".join(map(",".join, [names, *rows]))
    for old, new in changes.items():
        text = text.replace(*{"name": ("EyeBlinkLeft", new)}.get(old, (old, new)))
    return text


def test_takes_are_read_by_name_and_time_and_come_back(tmp_path: Path, shared: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(take_text())
    take = read_face(path)
    assert take.fps == 30.0 and take.weights.shape == (5, 52), "two frames of sixty a row, across a minute"
    assert (take.weights == 0.25).all() and take.angles[0].tolist() == [-0.5, 0, 0, 0.1, 0, 0, 0, 0, 0]
    columns = ["eyeBlink_L" if name == "eyeBlinkLeft" else name for name in reversed(ARKIT)]
    rows = [[str(0.5 + f / 24), *(str(i / 100) for i in reversed(range(52)))] for f in range(4)]
    path.write_text("\n".join(map(",".join, [["time", *columns], *rows])))
    take = read_face(path)
    assert take.fps == 24.0 and not take.angles.any()
    np.testing.assert_allclose(take.weights, np.tile(np.arange(52) / 100, (4, 1)))
    for name, frames in (("Sad_167", 1828), ("Neutral", 3051)):
        take = read_face(shared / f"data/real/arkit_livelink/{name}.csv")
        assert (take.fps, len(take.weights)) == (60.0, frames) and take.angles.min() < -0.02
        write_face(path, take)
        again = read_face(path)
        np.testing.assert_allclose(again.weights, take.weights, atol=1e-9)  # ten digits are written
        np.testing.assert_allclose(again.angles, take.angles, atol=1e-9)


DAMAGED = {
    "cut": (take_text()[:-40], ":6: "),
    "percent": (take_text().replace("0.25", "25.0"), ":2: EyeBlinkLeft is 25.0; weights lie between 0 and 1"),
    "nan": (take_text().replace("0.25", "nan", 1), ":2: EyeBlinkLeft is nan"),
    "words": (take_text().replace("0.25", "closed", 1), ": column 'EyeBlinkLeft': could not convert"),
    "unknown shape": (take_text(name="EyeWink"), ": no column for eyeBlinkLeft (1 of ARKit's 52 shapes)"),
    "time stands still": (take_text().replace("10:00:59:58", "10:00:59:56"), ":3: time does not go on"),
    "no time": (take_text().replace("Timecode", "Take"), ": no column of time"),
    "one frame": (take_text(1), ": 1 frames; a take has"),
    "degrees": (take_text().replace("-0.5", "-28.6"), ":2: HeadYaw is -28.6; angles are in radians"),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_damaged_takes_are_refused_by_line(damage: str, tmp_path: Path) -> None:
    path, (text, says) = tmp_path / "a.csv", DAMAGED[damage]
    path.write_text(text)
    with pytest.raises(UserError) as caught:
        read_face(path)
    assert str(caught.value).startswith(f"{path}{says}")


def test_the_table_has_a_row_a_frame(tmp_path: Path) -> None:
    weights = np.linspace(0, 1, 3 * 52).reshape(3, 52)
    write_arkit_csv(tmp_path / "a.csv", weights, 20.0)
    with (tmp_path / "a.csv").open() as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["time", *ARKIT]
    found = np.array(rows[1:], dtype=float)
    np.testing.assert_allclose(found[:, 0], [0, 0.05, 0.1])
    np.testing.assert_allclose(found[:, 1:], weights, atol=1e-5)
    with pytest.raises(UserError, match="52"):
        write_arkit_csv(tmp_path / "b.csv", weights[:, :3], 20.0)
