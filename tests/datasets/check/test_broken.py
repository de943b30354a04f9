"""Every source file of the broken set is read or refused as its EXPECT.md demands."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

from motionloom.datasets.audio.sound import read_sound
from motionloom.datasets.convert.aistpp.pickle_reader import read_aist_motion
from motionloom.datasets.convert.bvh.read import read_motion
from motionloom.datasets.convert.captions.humanml_text import read_humanml_captions
from motionloom.datasets.convert.common.arrays import load_array
from motionloom.datasets.convert.common.splits import read_ids
from motionloom.datasets.convert.motionx.parameters import value_limits
from motionloom.datasets.schema import UserError

REJECTED: dict[str, list[str] | None] = yaml.safe_load(
    Path(__file__).with_name("broken.yaml").read_text("utf-8")
)
"""File -> words that the refusal must hold; None for a file that is to be read."""


def read_captions(path: Path) -> None:
    captions, problems = read_humanml_captions(path, seconds=10.0)
    if problems or not captions:
        raise UserError(f"{path}: {'; '.join(problems) or 'no captions'}")


READERS: dict[str, Callable[[Path], object]] = {
    "npy": lambda path: load_array(path, width=322, limit=value_limits()),
    "aist": read_aist_motion,
    "bvh": lambda path: read_motion(path.read_bytes(), str(path)),
    "texts": read_captions,
    "wav": read_sound,
    "splits": read_ids,
}


@pytest.fixture(autouse=True)
def untouched(shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Runs in an empty folder, and fails if any payload ran or anything was written."""
    here = tmp_path / "cwd"
    here.mkdir()
    monkeypatch.chdir(here)
    broken = shared / "data" / "broken"
    before = sorted(broken.rglob("*"))
    yield here
    assert not list(here.iterdir()), "reading wrote something"
    assert not list(Path("/tmp").glob("PWNED_*")) and not list(tmp_path.rglob("PWNED_*"))
    assert sorted(broken.rglob("*")) == before


@pytest.fixture
def broken(shared: Path) -> Path:
    return shared / "data" / "broken"


@pytest.mark.parametrize("name", REJECTED)
def test_verdict(broken: Path, name: str) -> None:
    words, read = REJECTED[name], READERS[name.partition("/")[0]]
    if words is None:
        read(broken / name)
        return
    with pytest.raises(UserError) as refused:  # no exception of any other class
        read(broken / name)
    assert str(refused.value).startswith(f"{broken / name}:")
    for word in words:
        assert word in str(refused.value)


def test_the_table_has_every_file(broken: Path) -> None:
    there = {str(path.relative_to(broken)) for path in broken.rglob("*.*") if path.parent.name in READERS}
    assert there == set(REJECTED) and len(there) == 50
