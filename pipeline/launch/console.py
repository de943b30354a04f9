"""The two consoles: results on standard output, errors on standard error."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console
from rich.text import Text

from motionloom.datasets.base.printable import printable
from motionloom.pipeline.launch.process import process_rank


class SafeConsole(Console):
    """Writes out characters of strangers' text (captions, names) that a terminal or a log would obey, and
    makes no emoji of their colons."""

    def __init__(self, **how: Any) -> None:
        super().__init__(**{"emoji": False, **how})

    def render_str(self, text: str, **how: Any) -> Text:  # type: ignore[override]
        return super().render_str("\n".join(map(printable, text.split("\n"))), **how)


def make_console(*, aside: bool = False) -> Console:
    """Standard output; silent on every rank but the first, wide enough for tables in a log file.

    `aside` takes standard error, where standard output is for a program.
    """
    width = None if os.environ.get("COLUMNS") or os.isatty(2 if aside else 1) else 120
    return SafeConsole(stderr=aside, quiet=process_rank() > 0, width=width, highlight=False)


def say(console: Console, text: object, style: str | None = None) -> None:
    """Print one line without markup: names and captions may be a stranger's, for no terminal to obey."""
    console.print(printable(str(text)), style=style, markup=False, highlight=False, soft_wrap=True)


def _tell_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Print a warning as one sentence; one of another package begins with that package's name."""
    # Python's own lines quote a place in the source, which tells users nothing.
    package = Path(filename.partition("site-packages")[2]).parts[1:2]
    who = "" if package in ((), ("motionloom",)) else f"{package[0].removesuffix('.py')}: "
    say(make_console(aside=True), f"note: {who}{' '.join(str(message).split())}", "yellow")


def _tell_unraisable(error: sys.UnraisableHookArgs) -> None:
    """Say what no caller can be told, but for loaders whose workers could not be started."""
    if "_MultiProcessingDataLoaderIter" not in str(error.object):
        sys.__unraisablehook__(error)


def quiet_libraries() -> None:
    """Keep the libraries' chatter out of the way of our own lines."""
    sys.unraisablehook = _tell_unraisable
    warnings.showwarning = _tell_warning
    os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
    # Threads that wait sleep: awake they take the cores of those they wait for, wherever a machine is shared.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("KMP_BLOCKTIME", "0")
    os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")  # stacks of C++ where another process has died
    os.environ.setdefault("HF_HUB_DISABLE_PROGRESS_BARS", "1")
    os.environ.setdefault("TRANSFORMERS_NO_ADVISORY_WARNINGS", "1")
    for name in (
        "lightning.pytorch",
        "lightning.fabric",
        "lightning.fabric.utilities.distributed",
        "lightning.pytorch.utilities.rank_zero",
    ):
        logging.getLogger(name).setLevel(logging.ERROR)
    for message in (
        ".*does not have many workers.*",
        ".*Checkpoint directory.*",
        ".*litlogger.*",
        ".*sync_dist.*",
        ".*LeafSpec.*",
        ".*ckpt_path.*",
        ".*dirpath has changed.*",
        ".*`on_before_batch_transfer`.*",  # ours looks at a batch on the host, whoever loads it
        ".*`srun` command is available.*",  # said of every process that srun did not start
    ):
        warnings.filterwarnings("ignore", message)
