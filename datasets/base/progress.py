"""Progress of long work: a bar on a terminal, elsewhere a line now and then, both with the time left."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

LINE_EVERY_SECONDS = 15.0
"""Between two lines where there is no terminal."""


def duration(seconds: float) -> str:
    """ "12 s", "3 min 20 s", "2 h 05 min", "10 d 9 h"."""
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.1f} s" if seconds < 9.95 else f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    if whole < 2 * 86400:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    return f"{whole // 86400} d {whole % 86400 // 3600} h"


class Pace:
    """Decides when a line is due, and estimates the time that the rest takes at the speed so far."""

    def __init__(self, total: int, first: int = 0, clock: Callable[[], float] = time.monotonic) -> None:
        self.total = total
        self.first = first
        self._clock = clock
        self._began = self._said = clock()

    def due(self, done: int) -> bool:
        """Whether to say something now: every 15 s, and at the end of what took as long."""
        now = self._clock()
        ended = done >= self.total and now - self._began >= LINE_EVERY_SECONDS
        if now - self._said < LINE_EVERY_SECONDS and not ended:
            return False
        self._said = now
        return True

    def speed(self, done: int) -> float:
        return (done - self.first) / max(1e-9, self._clock() - self._began)

    def left(self, done: int) -> str:
        """The time that the rest takes, in words; nothing where that cannot be said."""
        rest = self.total - done
        speed = self.speed(done)
        return f"{duration(rest / speed)} left" if rest > 0 and speed > 0 else ""


class Meter:
    """Counts what is done of one piece of work: `with Meter("generating", 40) as meter: meter.advance()`."""

    def __init__(
        self,
        name: str,
        total: int,
        *,
        done: int = 0,
        console: Console | None = None,
        shown: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._name = name
        self._done = done
        self._console = console or Console(highlight=False)
        self._shown = shown and not self._console.quiet
        self._pace = Pace(total, done, clock)
        self._bar = bar(self._console, shown=self._shown)
        self._task: TaskID = self._bar.add_task(name, total=total, completed=done, note="")

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def advance(self, count: int = 1) -> None:
        self._done += count
        self._bar.update(self._task, completed=self._done)
        if self._shown and not self._console.is_terminal and self._pace.due(self._done):
            left = self._pace.left(self._done)
            line = f"    {self._name}: {self._done}/{self._pace.total}"
            self._console.print(f"{line}  {left}" if left else line, soft_wrap=True, markup=False)


def bar(console: Console, *, shown: bool = True) -> Progress:
    """A progress bar on a terminal; silent elsewhere, where lines are printed."""
    return Progress(
        TextColumn("    {task.description:<18}"),
        BarColumn(bar_width=36),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=console,
        disable=not shown or not console.is_terminal,
        transient=False,
    )
