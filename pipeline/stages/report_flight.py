"""What the flight recorders of a run's trainings have noted, on the page that `motionloom report` makes.

It holds times, so a page made within a run, which equal runs make equal, does not have it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from motionloom.pipeline.render.charts import Line
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.store.crash import FOLDER as CRASHES
from motionloom.pipeline.store.flight_log import read_flight
from motionloom.pipeline.store.run_state import RunState

Rows = Sequence[Mapping[str, Any]]
_MOST = 8
"""Layer groups in one chart: as many as there are colours. Those with the largest gradients are drawn."""


def draw_flights(page: Page, state: RunState) -> None:
    """Speed and waits of every training, its step times and the gradients of its layer groups."""
    flights = {stage.name: read_flight(stage.folder) for stage in state.stages}
    flights = {name: ranks for name, ranks in flights.items() if ranks}
    if not flights:
        return
    page.add_heading("How the trainings ran")
    page.add_text(
        "As the flight recorders saw it: a row every 10 steps, of long trainings fewer in the past."
    )
    columns = ["training", "samples/s", "waited for data, %", "for checkpoints, %", "for other ranks, %"]
    table = [[name, *_waits(ranks)] for name, ranks in flights.items()]
    page.add_table(columns, table, "Speed and waits, means of the rows and ranks", digits=1, pinned=True)
    crashed = [
        f"{stage.name}: {bundle}"
        for stage in state.stages
        for bundle in sorted((stage.folder / CRASHES).glob("step_*"))
    ]
    if crashed:
        page.add_text("Crash bundles, each to be repeated with motionloom replay:")
        page.add_list(crashed)
    with page.folded("Step times and gradients by layer group"):
        for name, ranks in flights.items():
            page.add_plot(_times(ranks), f"{name}: seconds a step", y_label="s", log_y=True)
            first = ranks[min(ranks)]
            page.add_plot(norm_lines(first), f"{name}: gradient norms by layer group", log_y=True)


def _waits(ranks: Mapping[int, Rows]) -> list[float | str | None]:
    rows = [row for own in ranks.values() for row in own]
    shares = [
        [row.get("waited", {}).get(cause, 0.0) for row in rows] for cause in ("data", "checkpoints", "ranks")
    ]
    speed = _mean([row["samples_per_second"] for row in rows if "samples_per_second" in row])
    return [speed, *(100 * _mean(share) for share in shares)]


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else 0.0


def _times(ranks: Mapping[int, Rows]) -> list[Line]:
    out = []
    for rank, rows in list(ranks.items())[: _MOST // 2]:
        steps = [row["step"] for row in rows]
        whose = f", rank {rank}" if len(ranks) > 1 else ""
        out.append(Line(f"median{whose}", steps, [row["step_seconds"] for row in rows]))
        out.append(Line(f"95 %{whose}", steps, [row["step_seconds_p95"] for row in rows], dashed=True))
    return out


def norm_lines(rows: Rows) -> list[Line]:
    """A curve for each layer group, in the order in which the network has them."""
    norms = [row.get("grad_norm", {}) for row in rows]
    names = list(dict.fromkeys(name for row in norms for name in row))
    largest = {name: _mean([row[name] for row in norms if name in row]) for name in names}
    drawn = set(sorted(names, key=lambda name: -largest[name])[:_MOST])
    out = []
    for name in (name for name in names if name in drawn):
        points = [(row["step"], own[name]) for row, own in zip(rows, norms, strict=True) if name in own]
        out.append(Line(name, [step for step, _ in points], [norm for _, norm in points]))
    return out
