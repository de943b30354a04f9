"""ARKit weights against scipy's bounded least squares, and bases that are refused."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from motionloom.datasets.schema import UserError
from motionloom.pipeline.render.body.face import ARKIT, ArkitBases, bounded_least_squares, write_arkit_csv


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
