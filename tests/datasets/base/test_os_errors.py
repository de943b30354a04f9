"""What the system refuses becomes a sentence, however a library has wrapped it; a bug does not."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file

from motionloom.datasets.base.files import atomic_path, write_text
from motionloom.datasets.base.os_errors import of_the_machine, sentence_of

FULL = Path("/dev/full")


def raised(work: object) -> BaseException:
    with pytest.raises(Exception) as caught:  # the test asks which
        work()  # type: ignore[operator]
    return caught.value


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.ENOSPC, "the disk is full; free space"),
        (errno.EROFS, "read-only file system"),
        (errno.EACCES, "no permission"),
        (errno.EMFILE, "too many open files"),
        (errno.ENOTDIR, "a file stands where a folder is needed"),
        (errno.ENOENT, "no such file or folder"),
    ],
)
def test_each_refusal_has_words_and_names_the_file(number: int, words: str) -> None:
    sentence = sentence_of(OSError(number, os.strerror(number), "runs/a/file"))
    assert sentence is not None and sentence.startswith("runs/a/file: ") and words in sentence
    assert "\n" not in sentence and "Errno" not in sentence
    nameless = sentence_of(OSError(number, os.strerror(number)))
    assert nameless is not None and words in nameless and not nameless.startswith("None")


def test_what_numpy_and_torch_make_of_a_full_disk() -> None:
    with FULL.open("wb") as file:
        error = raised(lambda: np.savez(file, big=np.zeros(100_000)))
        with pytest.raises(OSError):
            file.flush()
        os.dup2(os.open(os.devnull, os.O_WRONLY), file.fileno())
    assert "the disk is full" in str(sentence_of(error))
    error = raised(lambda: torch.save({"big": torch.zeros(1_000_000)}, FULL))
    assert "disk" in str(sentence_of(error)) and "full" in str(sentence_of(error))


def test_what_safetensors_makes_of_a_file_in_the_way(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    error = raised(lambda: save_file({"a": np.zeros(3)}, tmp_path / "file" / "below"))
    assert "a file stands where a folder is needed" in str(sentence_of(error))


def test_an_error_while_writing_names_the_file_that_was_wanted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_text(tmp_path / "old.json", "whole")

    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    error = raised(lambda: write_text(tmp_path / "old.json", "other"))
    assert str(sentence_of(error)).startswith(f"{tmp_path / 'old.json'}: the disk is full")
    assert (tmp_path / "old.json").read_text() == "whole"
    assert [path.name for path in tmp_path.iterdir()] == ["old.json"]


def test_an_error_of_another_file_keeps_its_name(tmp_path: Path) -> None:
    def work() -> None:
        with atomic_path(tmp_path / "made"):
            (tmp_path / "missing").read_text()

    error = raised(work)
    assert isinstance(error, OSError) and error.filename == str(tmp_path / "missing")


def test_a_machine_at_its_limits_is_no_bad_clip() -> None:
    assert of_the_machine(OSError(errno.ENOSPC, "")) and of_the_machine(OSError(errno.EMFILE, ""))
    assert not of_the_machine(OSError(errno.EACCES, "")) and not of_the_machine(ValueError())
