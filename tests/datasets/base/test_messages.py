"""What is said: a sentence for what the system refuses, lines of progress, text of strangers made safe."""

from __future__ import annotations

import errno
import io
import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rich.console import Console
from safetensors.numpy import save_file

from motionloom.datasets.base.files import atomic_path, write_text
from motionloom.datasets.base.os_errors import SHARED_MEMORY, full_place, of_the_machine, sentence_of
from motionloom.datasets.base.printable import printable
from motionloom.datasets.base.progress import Meter, Pace

FULL = Path("/dev/full")


def raised(work: object) -> BaseException:
    with pytest.raises(Exception) as caught:  # the test asks which
        work()  # type: ignore[operator]
    return caught.value


def test_full_shared_memory_is_called_that(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In torch's words, which are those of 2.13; and where an error names no file, by what is full."""
    for words in (
        "unable to write to file </torch_7_1_0>: No space left on device (28)",
        "DataLoader worker (pid 7) is killed by signal: Bus error. It is possible that dataloader's workers "
        "are out of shared memory. Please try to raise your shared memory limit.",
    ):
        assert "hardware.workers" in str(sentence_of(RuntimeError(words)))
    error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    for free, place in (({SHARED_MEMORY: 2**14}, SHARED_MEMORY), ({str(tmp_path): 0}, str(tmp_path))):
        usage = {SHARED_MEMORY: 2**30, str(tmp_path): 2**30} | free
        monkeypatch.setattr(
            shutil, "disk_usage", lambda at, usage=usage: SimpleNamespace(free=usage[str(at)])
        )
        error.filename = None
        assert full_place(tmp_path) == place
        assert ("convert_workers: 1" in str(sentence_of(error))) == (place == SHARED_MEMORY)
        error.filename = place
        assert ("hardware.workers" in str(sentence_of(error))) == (place == SHARED_MEMORY)


def test_what_numpy_torch_and_safetensors_make_of_a_disk(tmp_path: Path) -> None:
    with FULL.open("wb") as file:
        error = raised(lambda: np.savez(file, big=np.zeros(100_000)))
        with pytest.raises(OSError):
            file.flush()
        os.dup2(os.open(os.devnull, os.O_WRONLY), file.fileno())
    assert "full" in str(sentence_of(error))
    for error in (MemoryError(), raised(lambda: torch.empty(2**55))):
        assert "out of memory" in str(sentence_of(error))
    error = raised(lambda: torch.save({"big": torch.zeros(1_000_000)}, FULL))
    assert "disk" in str(sentence_of(error)) and "full" in str(sentence_of(error))
    (tmp_path / "file").write_text("")
    error = raised(lambda: save_file({"a": np.zeros(3)}, tmp_path / "file" / "below"))
    assert "folder" in str(sentence_of(error))


def test_an_error_while_writing_names_the_file_that_was_wanted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_text(tmp_path / "old.json", "whole")

    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    error = raised(lambda: write_text(tmp_path / "old.json", "other"))
    assert str(sentence_of(error)).startswith(f"{tmp_path / 'old.json'}: ")
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


class Clock:
    """A clock that stands until it is set."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def test_time_left_goes_by_what_was_done_here_and_lines_come_every_15_seconds() -> None:
    """A resumed training had its first 400 steps from before: 100 steps in 50 s leave 1,000 s for 2,000."""
    clock = Clock()
    pace = Pace(2500, 400, clock)
    assert pace.left(400) == "", "nothing is known yet"
    clock.now += 50
    assert pace.speed(500) == 2.0
    assert pace.left(500).startswith("16 min 40")
    assert pace.left(2500) == ""
    clock = Clock()
    pace = Pace(10, clock=clock)
    due = []
    for done in range(1, 11):
        clock.now += 5
        due.append(pace.due(done))
    assert [number for number, said in enumerate(due, start=1) if said] == [3, 6, 9, 10]
    assert not Pace(10, clock=clock).due(10), "what is quick says nothing"


def test_a_meter_prints_lines_where_there_is_no_terminal() -> None:
    clock, log = Clock(), io.StringIO()
    with Meter("generating", 40, done=8, console=Console(file=log, width=100), clock=clock) as meter:
        for _ in range(4):
            clock.now += 10
            meter.advance(8)
    assert [line.split() for line in log.getvalue().splitlines()] == [
        ["generating:", "24/40", "20", "s", "left"],
        ["generating:", "40/40"],
    ]


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("walks\r\nfast\t", r"walks\r\nfast\t"),
        ("\x1b]0;owned\x07\x9b31m", r"\x1b]0;owned\x07\x9b31m"),
        ("left\u202egpj.exe", r"left\u202egpj.exe"),
        ("\ud800", r"\ud800"),
        ("跳舞\u3000Tänzer می\u200cرقصد 👩\u200d🚀\xa0é", "跳舞\u3000Tänzer می\u200cرقصد 👩\u200d🚀\xa0é"),
    ],
)
def test_no_character_commands_a_terminal_and_every_script_stays(text: str, shown: str) -> None:
    assert printable(text) == shown
