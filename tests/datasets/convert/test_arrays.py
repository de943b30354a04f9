"""Arrays from outside: every broken file is refused in one sentence, every valid variant is read alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from motionloom.datasets.convert.common.arrays import check_array_header, load_array, read_array_header
from motionloom.datasets.schema import UserError

REFUSED = {
    "truncated": r"truncated array: 15456 bytes expected for \[12, 322\], \d+ found",
    "truncated_header": "cut within its header",
    "empty_file": "empty file",
    "nan": "nan at frame 5, column 10$",
    "inf": "inf at frame 3, column 309$",
    "wrong_dims_321": r"expected \[T, 322\], found \[12, 321\]$",
    "transposed": r"expected \[T, 322\], found \[322, 12\]; it seems to be transposed",
    "one_dim": r"expected \[T, 322\], found \[322\]; one frame without the time axis",
    "three_dim": r"expected \[T, 322\], found \[1, 12, 322\]; a stray batch axis",
    "zero_length": "zero length",
    "huge_values": r"absurd value .* at frame 0, column 1; at most 1000",
    "object_dtype": "object array",
    "complex_dtype": "complex64; expected float32 or float64",
}
BY_HEADER = {"truncated", "truncated_header", "empty_file", "object_dtype"}
"""What `read_array_header` finds by itself."""
BY_VALUES = {"nan", "inf", "huge_values"}
"""What needs the data."""


@pytest.fixture
def npy(shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The broken files; the current directory is watched for what a pickle would leave."""
    monkeypatch.chdir(tmp_path)
    return shared / "data/broken/npy"


def test_every_file_is_covered(npy: Path) -> None:
    valid = {"big_endian", "fortran_order", "control_ok"}
    assert {path.stem for path in npy.iterdir()} == REFUSED.keys() | valid


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_broken_files_are_refused(npy: Path, tmp_path: Path, name: str) -> None:
    path = npy / f"{name}.npy"
    with pytest.raises(UserError, match=REFUSED[name]) as caught:
        load_array(path, width=322, limit=1000.0)
    assert str(caught.value).startswith(str(path))
    with pytest.raises(UserError, match=rf"^clip 7: .*{REFUSED[name]}|^clip 7: {REFUSED[name]}"):
        load_array(path, width=322, name="clip 7", limit=1000.0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_headers_tell_what_they_can(npy: Path, tmp_path: Path, name: str) -> None:
    path = npy / f"{name}.npy"
    if name in BY_HEADER:
        with pytest.raises(UserError, match=REFUSED[name]):
            read_array_header(path)
    else:
        shape, _ = read_array_header(path)
        assert shape
    if name in BY_VALUES:
        assert check_array_header(path, width=322) == 12
    else:
        with pytest.raises(UserError, match=REFUSED[name]):
            check_array_header(path, width=322)
    assert not list(tmp_path.iterdir())


def test_storage_variants_are_equal(npy: Path) -> None:
    control = load_array(npy / "control_ok.npy", width=322, limit=1000.0)
    assert control.shape == (12, 322)
    for name in ("big_endian", "fortran_order"):
        found = load_array(npy / f"{name}.npy", width=322, limit=1000.0)
        assert found.dtype == control.dtype == np.float32
        assert found.flags.c_contiguous
        assert found.dtype.isnative
        np.testing.assert_array_equal(found, control)
    assert read_array_header(npy / "control_ok.npy") == ((12, 322), np.dtype("<f4"))


def test_float64_stays(tmp_path: Path) -> None:
    values = np.random.default_rng(0).standard_normal((5, 22, 3))
    np.save(tmp_path / "a.npy", values)
    found = load_array(tmp_path / "a.npy", width=(22, 3))
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, values)
    with pytest.raises(UserError, match=r"expected \[T, 66\], found \[5, 22, 3\]"):
        load_array(tmp_path / "a.npy", width=66)


def test_limit_per_column(tmp_path: Path) -> None:
    values = np.array([[1.0, 50.0], [-3.0, 50.0]], dtype=np.float32)
    np.save(tmp_path / "a.npy", values)
    load_array(tmp_path / "a.npy", width=2, limit=np.array([3.0, 100.0]))
    with pytest.raises(UserError, match="absurd value -3 at frame 1, column 0; at most 2 is sensible"):
        load_array(tmp_path / "a.npy", width=2, limit=np.array([2.0, 100.0]))


@pytest.mark.parametrize("values", [np.zeros((3, 2), np.int64), np.zeros((3, 2), np.float16)])
def test_other_number_types(tmp_path: Path, values: np.ndarray) -> None:
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(UserError, match=f"values are {values.dtype.name}"):
        load_array(tmp_path / "a.npy", width=2)


def test_no_file_and_no_array(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"none\.npy: cannot be read"):
        load_array(tmp_path / "none.npy", width=2)
    (tmp_path / "folder.npy").mkdir()
    with pytest.raises(UserError, match=r"folder\.npy: cannot be read"):
        read_array_header(tmp_path / "folder.npy")
    (tmp_path / "text.npy").write_text("1 2 3")
    with pytest.raises(UserError, match=r"not an \.npy file"):
        read_array_header(tmp_path / "text.npy")


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
