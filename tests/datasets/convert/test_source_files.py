"""Arrays, caption lines and names from outside: read alike in every valid variant, else refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Caption
from motionloom.datasets.convert.captions.humanml_text import parse_caption, read_humanml_captions
from motionloom.datasets.convert.common.arrays import load_array
from motionloom.datasets.convert.common.files import inside
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import MotionLayout


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
    with pytest.raises(UserError, match=r"frame 1, column 0.*2"):
        load_array(tmp_path / "a.npy", width=2, limit=np.array([2.0, 100.0]))


TOKENS = "a/DET person/NOUN walk/VERB"


def line(text: str, start: object = "0.0", end: object = "0.0", tokens: str = TOKENS) -> str:
    return f"{text}#{tokens}#{start}#{end}"


def test_arrays_beyond_the_limit_are_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    frames, layout = 2**27, MotionLayout.named("h3d263")
    with path.open("wb") as file:  # sparse: 2 GiB that take no room
        head = {"descr": "<f8", "fortran_order": False, "shape": (frames, 2)}
        np.lib.format.write_array_header_1_0(file, head)
        file.truncate(file.tell() + frames * 16)
    for read in (lambda: load_array(path, width=2), lambda: FeatureStats.of_arrays(path, path, layout)):
        with pytest.raises(UserError, match=r"a\.npy: .* bytes; at most"):
            read()


@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
def test_line_ends_and_a_byte_order_mark(tmp_path: Path, ending: str) -> None:
    path = tmp_path / "1.txt"
    path.write_bytes(b"\xef\xbb\xbf" + ending.join([line("one"), "", line("two")]).encode())
    captions, problems = read_humanml_captions(path, seconds=None)
    assert [c.text for c in captions] == ["one", "two"]
    assert not problems


@pytest.mark.parametrize(
    ("given", "caption"),
    [
        (line("a  man_walks", " 0.0 ", "0.0\r"), Caption(text="a man walks", tokens=TOKENS.split())),
        (line("x walks", "nan", "2.0"), Caption(text="x walks", end=2.0, tokens=TOKENS.split())),
        (line("x walks", 1, "9.4"), Caption(text="x walks", start=1, end=9.0, tokens=TOKENS.split())),
        (line("x walks", tokens=""), Caption(text="x walks")),
        # What taggers make of blanks and of the hash itself.
        (line("x walks", tokens="x/X /SPACE"), Caption(text="x walks", tokens=["x/X"])),
        (
            line("move #3", tokens="move/VERB #/SYM 3/NUM"),
            Caption(text="move #3", tokens=["move/VERB", "#/SYM", "3/NUM"]),
        ),
        (line("x walks", 2, 2), Caption(text="x walks", tokens=TOKENS.split())),
    ],
)
def test_good_lines(given: str, caption: Caption) -> None:
    assert parse_caption(given, seconds=9.0) == caption.model_copy(update={"source": "humanml3d"})


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (line("x walks", 2, "nan"), "not after its start"),
        (line("x walks", 0, "inf"), "is no number"),
        (line("x walks", 0, "9.6"), "beyond the clip"),
        (line("x walks", "9.0", "9.3"), "beyond the clip"),
        ("move #3#0.0#0.0", "no word/POS tokens"),
        (line("M007482"), "no usable caption"),
    ],
)
def test_bad_lines(given: str, reason: str) -> None:
    with pytest.raises(UserError, match=reason):
        parse_caption(given, seconds=9.0)


def test_inside_keeps_names_in_their_folder(tmp_path: Path) -> None:
    root = tmp_path / "root"
    (root / "sub").mkdir(parents=True)
    (root / "sub/1.txt").write_text("x")
    (tmp_path / "secret.txt").write_text("x")
    (root / "out.txt").symlink_to(tmp_path / "secret.txt")
    (root / "up").symlink_to(tmp_path)
    (root / "loop").symlink_to(root / "loop")
    (root / "near.txt").symlink_to(root / "sub/1.txt")
    (tmp_path / "linked").symlink_to(root)
    for name in ("sub/1.txt", "sub/absent.txt", "near.txt"):
        assert inside(root, name) == root / name
        assert inside(tmp_path / "linked", name) == tmp_path / "linked" / name
    for name in ("../secret.txt", "/etc/passwd", "sub/../../secret.txt", "C:/x", "a\\b", "", ".", "sub//1"):
        with pytest.raises(UserError, match="plain relative name"):
            inside(root, name)
    for name in ("out.txt", "up/secret.txt", "loop"):
        with pytest.raises(UserError, match=f"^{name}: .*leaves root/"):
            inside(root, name)
