"""Workers of a conversion leave the last word to their parent; what killed processes leave is removed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from motionloom.datasets.base.files import temporary_folder
from motionloom.pipeline.store.files import new_files, new_folder

PROGRAM = """
import signal, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # also where the tests run in the background
from motionloom.datasets.base.pool import Workers
if __name__ == "__main__":
    with Workers(2) as workers:
        list(workers.run(time.sleep, [SECONDS] * 2))
"""


def test_a_script_without_a_guard_runs_once(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(
        PROGRAM.replace('if __name__ == "__main__":', "if print('begun') is None:").replace("SECONDS", "0.1")
    )
    done = subprocess.run(
        [sys.executable, "-P", str(tmp_path / "script.py")], capture_output=True, text=True, timeout=50
    )
    assert (done.returncode, done.stdout.count("begun"), done.stderr) == (0, 1, "")


@pytest.mark.parametrize(("seconds", "after"), [(0.1, None), (60, 0.5), (60, 3.0)])
def test_of_ctrl_c_and_of_a_program_on_standard_input(seconds: float, after: float | None) -> None:
    """Whether they are still starting or at work; a program that they cannot read again is no error."""
    program = subprocess.Popen(
        [sys.executable, "-P", "-"], text=True, stdin=subprocess.PIPE, stderr=subprocess.PIPE, process_group=0
    )
    assert program.stdin is not None
    program.stdin.write(PROGRAM.replace("SECONDS", str(seconds)))
    program.stdin.close()
    program.stdin = None
    if after is not None:
        time.sleep(after)
        os.killpg(program.pid, signal.SIGINT)
    _, said = program.communicate(timeout=50)
    assert said.count("Traceback") == (after is not None) and "Process" not in said
    assert (program.returncode == 0) == (after is None)


def test_what_killed_commands_left_goes_with_the_next_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    other = tmp_path / "out/.mine.0123456789abcdef.tmp"
    other.mkdir(parents=True)
    for make in (
        lambda: new_files(tmp_path / "out"),
        lambda: new_folder(tmp_path / "export"),
        temporary_folder,
    ):
        ready, told = os.pipe()
        if not (child := os.fork()):
            with make() as folder:
                (folder / "half.npz").touch()
                os.write(told, str(folder).encode())
                time.sleep(600)
        left = Path(os.read(ready, 4096).decode())
        with make():
            assert (left / "half.npz").exists()
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        assert left.exists()
        with make() as mine:
            assert mine.is_dir() and not left.exists()
    assert other.is_dir(), "what has another name is another's"
