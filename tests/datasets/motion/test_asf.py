"""ASF/AMC against a slow reader that follows the format's text frame by frame, and its errors."""

from __future__ import annotations

import math
import re
import tarfile
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.bvh.asf import read_amc

ASF = """:version 1.10
:units
  mass 1.0
  length 0.45
  angle deg
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name hip
    direction 1 -1 0
    length 2
    axis 0 0 0 XYZ
  end
  begin
    id 2
    name thigh
    direction 0.34 -0.94 0
    length 7.6
    axis 10 -5 20 XYZ
    dof rx rz
    limits (-160 20)
           (-60 70)
  end
:hierarchy
  begin
    root hip
    hip thigh
  end
"""
AMC = """:FULLY-SPECIFIED
:DEGREES
1
root 1 17 -2 5 -40 80
thigh -30 12
2
root 1 17.5 -2 170 -89.9 3
thigh 1e1 -7
"""


def turn(axis: str, degrees: float) -> NDArray[np.float64]:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    rows = {
        "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
        "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
    }
    return np.array(rows[axis])


def slow_starts(asf: str, amc: str) -> list[dict[str, NDArray[np.float64]]]:
    """Start of every bone of every frame, in centimetres."""
    bones, tree, section, unit = {}, [], "", 1.0
    for words in filter(None, (line.split() for line in asf.splitlines())):
        section = words[0] if words[0].startswith(":") else section
        if section == ":units" and words[0] == "length":
            unit = 2.54 / float(words[1])
        elif section == ":bonedata" and words[0] == "begin":
            bone = {"dof": []}
        elif section == ":bonedata" and words[0] == "end":
            bones[bone["name"][0]] = bone
        elif section == ":bonedata" and words[0] != ":bonedata":
            bone[words[0]] = words[1:]
        elif section == ":hierarchy":
            tree += [(words[0], child) for child in words[1:]]
    frames = []
    for words in filter(None, (line.split() for line in amc.splitlines())):
        if len(words) == 1 and words[0].isdigit():
            frames.append({})
        elif frames:
            frames[-1][words[0]] = [float(word) for word in words[1:]]
    out = []
    for frame in frames:
        x, y, z, *angles = frame["root"]
        turned = {"root": turn("z", angles[2]) @ turn("y", angles[1]) @ turn("x", angles[0])}
        ends = starts = {"root": np.array([x, y, z])}
        starts = dict(ends)
        for parent, name in tree:
            bone = bones[name]
            a, b, c = (float(word) for word in bone["axis"][:3])
            axis, moved = turn("z", c) @ turn("y", b) @ turn("x", a), np.eye(3)
            for dof, angle in zip(bone["dof"], frame.get(name, []), strict=True):
                moved = turn(dof[1], angle) @ moved
            turned[name] = turned[parent] @ axis @ moved @ np.linalg.inv(axis)
            direction = np.array([float(word) for word in bone["direction"]])
            starts[name] = ends[parent]
            ends[name] = starts[name] + turned[name] @ direction / np.linalg.norm(direction) * float(
                bone["length"][0]
            )
        out.append({name: unit * place for name, place in starts.items()})
    return out


def assert_equal_to_slow(asf: bytes, amc: bytes, every: int = 1) -> None:
    motion = read_amc(asf, amc, name="a.amc")
    head, *frames = re.split(r"(?m)^(?=\d+\s*$)", amc.decode("latin1"))
    wanted = slow_starts(asf.decode("latin1"), "".join([head, *frames[::every]]))
    assert motion.frames == len(frames)
    places = motion.positions()[::every]
    for frame, starts in zip(places, wanted, strict=True):
        # float64 products of a dozen rotations, lengths of metres in centimetres
        np.testing.assert_allclose(frame, [starts[name] for name in motion.joints], atol=1e-9)


def test_joints_are_where_a_slow_reader_finds_them() -> None:
    assert_equal_to_slow(ASF.encode(), AMC.encode())
    assert_equal_to_slow(ASF.encode(), AMC.replace("\n", "\r\n").encode())


@pytest.mark.parametrize("count", [6, pytest.param(None, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("archive", "trials_there"), [("cmu/amc.tar.xz", 33), ("hdm05/hdm05.tar.xz", 232)])
def test_genuine_trials_agree_with_a_slow_reader(
    shared: Path, archive: str, trials_there: int, count: int | None
) -> None:
    """The first few; or every trial whose skeleton is there."""
    texts = {}
    with tarfile.open(shared / "data" / "real" / archive) as files:
        for member in files:
            if member.isreg() and (count is None or member.name.endswith(".asf") or member.size < 400_000):
                texts[member.name] = files.extractfile(member).read()
    subjects = {name.removesuffix(".asf"): text for name, text in texts.items() if name.endswith(".asf")}
    trials = [(s, name) for name in texts for s in subjects if name.startswith(s + "_")][:count]
    assert len(trials) == (count or trials_there)
    for subject, name in trials:
        assert_equal_to_slow(subjects[subject], texts[name], every=50 if count else 500)


@pytest.mark.parametrize(
    ("asf", "amc", "says"),
    [
        (ASF, AMC.replace("thigh -30 12", "thigh -30"), "frame 1"),
        (ASF, AMC.replace("thigh 1e1", "shank 1e1"), "frame 2"),
        (ASF, AMC.replace("thigh", "shank"), "'shank'"),
        (ASF, AMC.replace("17.5", "nan"), "'root'"),
        (ASF, AMC.replace("17.5", "up"), "up"),
        (ASF, ":DEGREES\n", "no frames"),
        (ASF.replace("hip thigh", "leg thigh"), AMC, "'leg thigh'"),
        (ASF.replace("length 7.6", "length long"), AMC, "long"),
        (ASF.replace(":hierarchy", ":tree"), AMC, ":hierarchy"),
    ],
)
def test_what_is_wrong_is_named(asf: str, amc: str, says: str) -> None:
    with pytest.raises(UserError, match=r"a\.amc") as error:
        read_amc(asf.encode(), amc.encode(), name="a.amc")
    assert says in str(error.value)
