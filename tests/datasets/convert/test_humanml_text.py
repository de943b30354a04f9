"""Text files of a source: caption lines, encodings, and names that must stay inside their folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from motionloom.datasets.convert.common import files
from motionloom.datasets.convert.common.files import inside, read_text_file
from motionloom.datasets.convert.common.humanml_text import parse_caption, read_humanml_captions
from motionloom.datasets.schema import Caption, UserError

TOKENS = "a/DET person/NOUN walk/VERB"


def line(text: str, start: object = "0.0", end: object = "0.0", tokens: str = TOKENS) -> str:
    return f"{text}#{tokens}#{start}#{end}"


FILES = {
    "bad_timestamps.txt": [
        line("a person walks", "start", "end"),
        line("a person runs", "5.0", "2.0"),
        line("a person sits", "-1.0", "3.0"),
        line("a person jumps", "0.0", "9999.0"),
    ],
    "nan_tags.txt": [line("a person bows", "nan", "nan")],
    "too_few_fields.txt": ["a person walks forward", "a person turns#a/DET person/NOUN turn/VERB"],
    "extra_hash.txt": [line("a person does move #3", tokens="a/DET person/NOUN do/VERB move/NOUN")],
    "empty_caption.txt": ["#a/DET#0.0#0.0", "", "   "],
    "empty_file.txt": [],
}


@pytest.fixture
def broken(tmp_path: Path) -> Path:
    """Caption files with one mistake each."""
    for name, lines in FILES.items():
        (tmp_path / name).write_text("".join(f"{text}\n" for text in lines))
    (tmp_path / "non_utf8.txt").write_bytes(line("a person walks to the café").encode("latin-1") + b"\n")
    return tmp_path


def test_captions_as_they_are_published(tmp_path: Path) -> None:
    path = tmp_path / "900002.txt"
    lines = [
        line("a person walks forward and then turns to the left."),
        line("a figure walks around a corner, bending left"),
        line("walking straight", "0.0", "2.0", tokens="walk/VERB straight/ADV"),
        line("the person turns left.", "1.0", "3.5"),
    ]
    path.write_text("".join(f"{text}\n" for text in lines))
    captions, problems = read_humanml_captions(path, seconds=69 / 20)
    assert not problems
    assert [(c.text, c.start, c.end) for c in captions] == [
        ("a person walks forward and then turns to the left.", 0.0, None),
        ("a figure walks around a corner, bending left", 0.0, None),
        ("walking straight", 0.0, 2.0),
        ("the person turns left.", 1.0, 69 / 20),  # the file says 3.5 s: 50 ms past the end
    ]
    assert captions[2].tokens == ["walk/VERB", "straight/ADV"]
    assert {c.source for c in captions} == {"humanml3d"}


def test_bad_timestamps_are_reported_line_by_line(broken: Path) -> None:
    captions, problems = read_humanml_captions(broken / "bad_timestamps.txt", seconds=10.0)
    assert captions == []
    assert [p.split(":")[0] for p in problems] == ["line 1", "line 2", "line 3", "line 4"]
    assert "'start' is not a number" in problems[0]
    assert "ends at 2 s, not after its start at 5 s" in problems[1]
    assert "start -1.0 s is not a time" in problems[2]
    assert "beyond the clip of 10.00 s" in problems[3]


def test_nan_tags_are_the_whole_clip(broken: Path) -> None:
    captions, problems = read_humanml_captions(broken / "nan_tags.txt", seconds=10.0)
    assert not problems
    assert [(c.text, c.start, c.end) for c in captions] == [("a person bows", 0.0, None)]


def test_too_few_fields(broken: Path) -> None:
    captions, problems = read_humanml_captions(broken / "too_few_fields.txt", seconds=10.0)
    assert captions == []
    assert [p[:24] for p in problems] == ["line 1: 1 of the 4 field", "line 2: 2 of the 4 field"]


def test_a_caption_with_a_hash(broken: Path) -> None:
    captions, problems = read_humanml_captions(broken / "extra_hash.txt", seconds=10.0)
    assert not problems
    assert captions[0].text == "a person does move #3"
    assert captions[0].tokens == ["a/DET", "person/NOUN", "do/VERB", "move/NOUN"]


@pytest.mark.parametrize("name", ["empty_caption.txt", "empty_file.txt"])
def test_no_usable_text(broken: Path, name: str) -> None:
    captions, problems = read_humanml_captions(broken / name, seconds=10.0)
    assert captions == []
    assert problems == ([] if name == "empty_file.txt" else ["line 1: the caption is empty"])


def test_other_encodings_are_refused_with_the_byte(broken: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"non_utf8\.txt: not UTF-8 text at byte 25 \(0xe9\)"):
        read_humanml_captions(broken / "non_utf8.txt", seconds=10.0)
    path = tmp_path / "bom.txt"
    path.write_bytes(b"\xef\xbb\xbfab\xff")
    with pytest.raises(UserError, match=r"bom\.txt: not UTF-8 text at byte 5"):
        read_text_file(path)
    with pytest.raises(UserError, match=r"^texts/1\.txt: not UTF-8"):
        read_text_file(path, "texts/1.txt")


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
    ],
)
def test_good_lines(given: str, caption: Caption) -> None:
    assert parse_caption(given, seconds=9.0) == caption.model_copy(update={"source": "humanml3d"})


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (line("x walks", 2, 2), "not after its start"),
        (line("x walks", 2, "nan"), "not after its start"),
        (line("x walks", 0, "inf"), "not a time"),
        (line("x walks", 0, "9.6"), "beyond the clip"),
        (line("x walks", "9.0", "9.3"), "beyond the clip"),
        (line("x walks", "", ""), "not a number"),
        ("move #3#0.0#0.0", "no word/POS tokens"),
        (line("M007482"), "no usable caption"),
    ],
)
def test_bad_lines(given: str, reason: str) -> None:
    with pytest.raises(UserError, match=reason):
        parse_caption(given, seconds=9.0)


def test_unreadable_files_are_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="No such file"):
        read_text_file(tmp_path / "absent.txt")
    with pytest.raises(UserError, match="cannot read"):
        read_text_file(tmp_path)
    (tmp_path / "long.txt").write_text("12345")
    monkeypatch.setattr(files, "MAX_TEXT_BYTES", 4)
    with pytest.raises(UserError, match="more than 4 bytes"):
        read_text_file(tmp_path / "long.txt")


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
        with pytest.raises(UserError, match="not a plain relative name"):
            inside(root, name)
    for name in ("out.txt", "up/secret.txt", "loop"):
        with pytest.raises(UserError, match=f"^{name}: a link that leaves root/"):
            inside(root, name)
