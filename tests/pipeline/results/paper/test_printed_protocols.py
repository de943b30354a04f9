"""How rows of a column were measured differently, by `metrics.json` itself, is printed below the table."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from motionloom.pipeline.evaluation.figures import FILE_NAME, Fact, FigureFile
from motionloom.pipeline.results.paper.compare import paper_table, shipped_tables
from motionloom.pipeline.results.paper.fill import fill

DIGESTS = {"clips_sha256": "clips", "judge": "judges"}


def unsaid(name: str, runs: dict[str, Path]) -> tuple[int, list[str]]:
    """How many facts differ between figures of one column of a table, and which of them it does not print."""
    table = paper_table(name)
    found, different, missing = fill(name, table, tuple(runs.values())), 0, []
    notes = " ".join(found.notes)
    for at, column in enumerate(table.columns):
        if column.figure is None or "{" in column.figure:
            continue
        protocols: list[dict[str, Fact]] = []
        for row in found.rows:
            for evaluation in row.evaluations if row.source != "paper" and row.cells[at] else ():
                file = FigureFile.read(runs[row.run] / "stages" / evaluation / FILE_NAME)
                if file.kind == column.of:
                    protocols += [dict(one.protocol) for one in file.figures if one.name == column.figure]
        for fact in {fact for protocol in protocols for fact in protocol}:
            values = {str(protocol.get(fact)) for protocol in protocols}
            said = f"different {DIGESTS[fact]}" if fact in DIGESTS else f"{fact} ("
            if len(values) > 1:
                different += 1
                missing += [] if said in notes else [f"{name} {column.title}: {fact} {values}"]
    return different, missing


def dancing(records: ModuleType, run: Path, repeats: int, **protocol: Fact) -> Path:
    """A run of UDE's engine with figures of captions and of dances."""
    facts: dict[str, Fact] = {"clips": 40, "repeats": repeats, "sampling.temperature": 1.0, **protocol}
    kinds = [f"movement.{kind}" for kind in ("fid_k", "fid_m", "div_k", "mm_m")]
    dances = [records.figure(name, 3.0, protocol=facts) for name in [*kinds, "position.ape_joints"]]
    made = {"made_by": {"generator": "ude"}}
    stages: dict[str, Any] = {
        "data": {"kind": "synth", "config": {"clips": 8}},
        "utt": {"kind": "utt", "config": {"net": {"kind": "gpt"}}},
        "dmd": {"kind": "dmd"},
        "ude": {"kind": "ude", "config": {"inject_z": True}, "inputs": {"utt": "utt", "dmd": "dmd"}},
        "evaluate": {
            "kind": "evaluate",
            "inputs": {"data": "data", "generators.ude": "ude"},
            "figures": records.by_text(1.0, 0.5, generator="ude", repeats=repeats, **protocol),
        },
        "evaluate_dances": {
            "kind": "evaluate_dances",
            "inputs": {"data": "data", "generators.ude": "ude"},
            "figures": FigureFile("evaluate_dances", tuple(dances), made),
        },
    }
    return Path(records.write_run(run, stages))


@pytest.mark.parametrize("paper", ["humantomato", "ude"])
def test_no_difference_goes_unsaid(
    paper: str, baselines: Callable[..., Path], records: ModuleType, tmp_path: Path
) -> None:
    if paper == "ude":
        nested = dancing(records, tmp_path / "two", 3, decodings=30, judge="b")
        runs = {"one": dancing(records, tmp_path / "one", 5), "two": nested}
    else:
        runs = {"one": baselines("one"), "two": baselines("two", judge="b")}
        other = records.by_text(4.0, 0.2, generator="temos", size=256, lengths="recorded", repeats=20)
        other.write(runs["two"] / "stages/evaluate_temos" / FILE_NAME)
        records.reconstruction(80.0, clips=30).write(runs["two"] / "stages/evaluate_vq" / FILE_NAME)
    # The runs have no figures of `motionloom retrieval`.
    names = [name for name in shipped_tables() if name.startswith(paper)]
    checked = [unsaid(name, runs) for name in names if set(paper_table(name).measures) - {"retrieval"}]
    assert sum(different for different, _ in checked) > 10
    assert [line for _, missing in checked for line in missing] == []
