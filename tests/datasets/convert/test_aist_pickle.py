"""AIST++ pickles: numbers come out, nothing else happens."""

from __future__ import annotations

import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.convert.aistpp.pickle_reader import read_aist_motion


def annotation(frames: int = 5, **changes: Any) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    data = {
        "smpl_loss": np.float64(0.25),
        "smpl_poses": rng.normal(size=(frames, 72)).astype(np.float32),
        "smpl_scaling": np.array([93.5], np.float32),
        "smpl_trans": rng.normal(size=(frames, 3)).astype(np.float32),
    }
    return {key: value for key, value in (data | changes).items() if value is not None}


def saved(folder: Path, data: object, protocol: int = 4) -> Path:
    path = folder / "a.pkl"
    path.write_bytes(pickle.dumps(data, protocol=protocol))
    return path


@pytest.mark.parametrize("protocol", range(6))
def test_every_protocol_gives_the_same_numbers(tmp_path: Path, protocol: int) -> None:
    data = annotation(smpl_poses=np.asfortranarray(annotation()["smpl_poses"]))
    path = saved(tmp_path, data, protocol)
    poses, trans = read_aist_motion(path)
    assert np.array_equal(poses, data["smpl_poses"])
    assert np.array_equal(trans, data["smpl_trans"] / np.float64(93.5))


def test_big_endian_and_old_numpy_names(tmp_path: Path) -> None:
    data = annotation()
    path = saved(tmp_path, data | {"smpl_trans": data["smpl_trans"].astype(">f8")}, 2)
    raw = path.read_bytes()
    assert raw.count(b"numpy._core.multiarray")
    path.write_bytes(raw.replace(b"numpy._core.multiarray", b"numpy.core.multiarray"))
    assert np.array_equal(read_aist_motion(path)[1], data["smpl_trans"] / np.float64(93.5))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"smpl_scaling": 10**400}, "smpl_scaling"),
        ({"smpl_poses": None}, "no key 'smpl_poses'"),
        ({"smpl_poses": np.zeros((5, 24, 3), np.float32)}, r"smpl_poses is \[5, 24, 3\], not \[T, 72\]"),
        ({"smpl_poses": np.zeros((0, 72), np.float32)}, "smpl_poses is"),
        ({"smpl_trans": np.full((5, 3), np.nan)}, "smpl_trans: nan at frame 0, column 0"),
        ({"smpl_trans": np.full((5, 3), 1e9)}, "smpl_trans: .*1000"),
        ({"smpl_poses": np.full((5, 72), 1e6)}, "smpl_poses: .*100"),
        ({"smpl_scaling": np.array([np.inf])}, r"smpl_scaling is \[inf"),
        ({"smpl_scaling": np.array([-93.0])}, r"smpl_scaling is \[-93"),
        ({"smpl_scaling": np.array([1.0, 2.0])}, r"smpl_scaling is \[1.0, 2.0"),
        ({"smpl_scaling": "93"}, "smpl_scaling"),
        ({"smpl_trans": np.array([["a"] * 3] * 5)}, "array type"),
        ({"smpl_trans": np.empty((5, 3), object)}, "array type"),
        ({"smpl_trans": np.zeros((5, 3), complex)}, "array type"),
        ({"smpl_trans": np.zeros(5, [("x", "f4")])}, "array type"),
    ],
)
def test_values_that_are_no_motion(tmp_path: Path, changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(UserError, match=rf"a\.pkl: .*{reason}"):
        read_aist_motion(saved(tmp_path, annotation(**changes)))


class Call:
    """Pickles as a call of anything."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.reduced = (function, arguments)

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return self.reduced


def test_no_other_global_is_reached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import builtins
    import codecs
    import os

    monkeypatch.chdir(tmp_path)
    attacks = [
        (Call(os.system, "touch PWNED"), "system'"),
        (Call(builtins.eval, "open('PWNED', 'w')"), r"'builtins\.eval'"),
        (Call(np.load, "a.pkl"), "'numpy.load'"),
        (Call(np.zeros, 10**12), "'numpy.zeros'|multiarray.zeros"),
        (Call(bytearray, 2**40), r"'builtins\.bytearray'"),
        (Call(codecs.decode, b"x", "zlib_codec"), r"'_codecs\.decode'"),
        (Path("x"), "pathlib"),
    ]
    for attack, reason in attacks:
        path = saved(tmp_path, annotation(extra=attack))
        with pytest.raises(UserError, match=rf"a\.pkl: refused, .*({reason})"):
            read_aist_motion(path)
        assert [found.name for found in tmp_path.iterdir()] == ["a.pkl"]


@pytest.mark.parametrize(
    ("stream", "reason"),
    [
        (b"\x80\x02}r\xff\xff\xff\xff.", "memo place 4294967295"),  # LONG_BINPUT: room for 2**32 entries
        (b"\x80\x04\x8d" + struct.pack("<Q", 2**62) + b"x.", "damaged"),
        (b"\x80\x05\x96" + struct.pack("<Q", 2**40) + b"x.", "damaged"),
        (b"\x80\x02" + b"N" * 2000 + b".", "more than 1000"),
        (b"cnumpy\ndtype\n.", "dict"),
        (b"(I1\nI2\nd.", "no key"),
        (b"(S'touch PWNED'\nios\nsystem\n.", r"os\.system"),  # INST names a class by itself
    ],
)
def test_hostile_instructions(tmp_path: Path, stream: bytes, reason: str) -> None:
    path = tmp_path / "a.pkl"
    path.write_bytes(stream)
    with pytest.raises(UserError, match=rf"a\.pkl: .*{reason}"):
        read_aist_motion(path)


@pytest.mark.parametrize(
    "value",
    [
        b"cnumpy\nndarray\n(I4\nt\x81",  # NEWOBJ of a record is no call of a class
        b"cnumpy\nndarray\n(I4\ntR",
        b"cnumpy._core.multiarray\n_reconstruct\n(I1\n(I0\ntS'b'\ntR",  # an array that is never filled
        b"cnumpy._core.multiarray\nscalar\n(cnumpy\ndtype\n(S'O8'\ntRS'x'\ntR",
        b"cnumpy._core.multiarray\n_reconstruct\n}b",  # the state of a function
        b"cnumpy\ndtype\n(S'f4'\ntR(I3\nS'>'\nNNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb",
    ],
)
def test_allowed_names_are_not_misused(tmp_path: Path, value: bytes) -> None:
    path = saved(tmp_path, annotation())
    raw = path.read_bytes()
    path.write_bytes(b"(S'smpl_poses'\n" + value + b"d.")
    with pytest.raises(UserError, match=r"a\.pkl: "):
        read_aist_motion(path)
    path.write_bytes(raw)
    assert read_aist_motion(path)[0].dtype == np.float32, "nothing outlives a file"
    assert np.dtype("f4").isnative


@pytest.mark.parametrize("frames", [b"J\xff\xff\xff\x7f", b"J\x00\x00\x10\x00"])
def test_shapes_beyond_their_data(tmp_path: Path, frames: bytes) -> None:
    path = saved(tmp_path, annotation(), 2)
    raw, shape = path.read_bytes(), b"K\x05K\x03\x86"
    assert raw.count(shape) == 1
    path.write_bytes(raw.replace(shape, frames + b"K\x03\x86"))
    with pytest.raises(UserError, match="smpl_trans"):
        read_aist_motion(path)


def test_other_things_than_annotations(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"absent\.pkl: cannot read"):
        read_aist_motion(tmp_path / "absent.pkl")
    with pytest.raises(UserError, match="list"):
        read_aist_motion(saved(tmp_path, [1, 2]))
