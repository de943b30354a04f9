"""Arrays from outside: every broken file is refused in one sentence, every valid variant is read alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from motionloom.datasets.convert.common.arrays import check_array_header, load_array
from motionloom.datasets.schema import UserError


@pytest.fixture
def npy(shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The broken files; the current directory is watched for what a pickle would leave."""
    monkeypatch.chdir(tmp_path)
    return shared / "data/broken/npy"


def test_storage_variants_are_equal(npy: Path) -> None:
    control = load_array(npy / "control_ok.npy", width=322, limit=1000.0)
    assert control.shape == (12, 322)
    for name in ("big_endian", "fortran_order"):
        found = load_array(npy / f"{name}.npy", width=322, limit=1000.0)
        assert found.dtype == control.dtype == np.float32
        assert found.flags.c_contiguous
        assert found.dtype.isnative
        np.testing.assert_array_equal(found, control)


def test_limit_per_column(tmp_path: Path) -> None:
    values = np.array([[1.0, 50.0], [-3.0, 50.0]], dtype=np.float32)
    np.save(tmp_path / "a.npy", values)
    load_array(tmp_path / "a.npy", width=2, limit=np.array([3.0, 100.0]))
    with pytest.raises(UserError, match="absurd value -3 at frame 1, column 0; at most 2 is sensible"):
        load_array(tmp_path / "a.npy", width=2, limit=np.array([2.0, 100.0]))


def test_no_file_and_no_array(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"none\.npy: cannot be read"):
        load_array(tmp_path / "none.npy", width=2)
    (tmp_path / "folder.npy").mkdir()
    with pytest.raises(UserError, match=r"folder\.npy: cannot be read"):
        check_array_header(tmp_path / "folder.npy", width=2)
    (tmp_path / "text.npy").write_text("1 2 3")
    with pytest.raises(UserError, match=r"not an \.npy file"):
        check_array_header(tmp_path / "text.npy", width=2)


def test_random_damage_never_escapes(npy: Path, tmp_path: Path) -> None:
    """Any byte of the header changed, or any cut: a `UserError` or a plain array, nothing else."""
    good = (npy / "control_ok.npy").read_bytes()
    random = np.random.default_rng(1)
    path = tmp_path / "a.npy"
    for trial in range(300):
        data = bytearray(good)
        if trial % 3 == 0:
            del data[int(random.integers(len(data))) :]
        else:
            for place in random.integers(128, size=1 + trial % 3):
                data[place] = int(random.integers(256))
        path.write_bytes(data)
        try:
            found = load_array(path, width=322)
        except UserError as error:
            assert str(path) in str(error)
        else:
            assert found.shape == (12, 322)
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.npy"]
