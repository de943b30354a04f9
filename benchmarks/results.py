"""Fill the tables of `docs/results.md` from the records in `benchmarks/records`.

    python benchmarks/results.py                     # updates docs/results.md
    python benchmarks/results.py --collect RUN...    # first makes records of runs of one recipe

A record is a table: its title, day, commit, command, protocol, columns, and rows whose cells are values, one
a seed, or text. A row knows the versions of the kinds of stages that it measured, and their settings; where
today's are others, the page says "of older code". Two values are both shown, several as their mean with a
95 % interval by Student's t over seeds. In the page, the table after the comment `<!--name-->` is that of the
record `name`; the text around the tables is edited in the page and holds no measured figure.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from bench import (
    HERE,
    RECORDS,
    SEEDS,
    Column,
    Record,
    arguments,
    command_line,
    report,
    settings_digest,
    table_of,
)

from motionloom.pipeline.contract.stage import stage_kinds
from motionloom.pipeline.evaluation.figures import (
    FILE_NAME,
    MODEL,
    NEAREST_LABELS,
    NEAREST_MUSIC,
    NEAREST_WORDS,
    RECORDED,
    FigureFile,
)
from motionloom.pipeline.store.run_state import StageRecord, finished_records
from motionloom.pipeline.store.yaml import flatten, read_yaml

PAGE = HERE.parent / "docs" / "results.md"
TABLE = re.compile(r"(<!--(\w+)-->\n)(?:\|.*\n)*(?:\n\*Of older code.*\n)?(?:\n\*Measured .*\n)?")
"""The name of a record, and what stands below it: the table, and the line that says how it was measured."""


class Table(NamedTuple):
    """A table of some stages: row -> (stage without its seed, row of its figures)."""

    title: str
    rows: Mapping[str, tuple[str, str]]
    columns: tuple[Column, ...]


TEXT = (
    Column("Top-1 among {candidates}, %", "tma.top-1", 1, 100),
    *(Column(f"{name}_{kind}", f"movement.{name.lower()}_{kind}", digits)
      for name, digits in (("FID", 1), ("Div", 2), ("MM", 2)) for kind in "km"),
)  # fmt: skip
MUSIC = (Column("Beat Align", "beat_align.bailando", 3), *TEXT[1:])
ANSWERS = {
    "recorded": RECORDED,
    "nearest training labels": NEAREST_LABELS,
    "nearest training caption": NEAREST_WORDS,
}
VARIANTS = {
    "GPT": "greedy",
    "GPT with z": "greedy_z",
    "GRU": "greedy_gru",
    "GPT, DMD predicts noise": "greedy_epsilon",
    "GPT, DMD predicts motion": "greedy_sample",
}


def _evaluated(*methods: str) -> dict[str, str]:
    return {name: f"evaluate_{name.lower()}" for name in methods}


RIVALS = {"T2M-GPT": "evaluate_t2m", **_evaluated("TEMOS", "MDM", "MLD", "MotionDiffuse"),
          "HumanTOMATO": "evaluate"}  # fmt: skip
RIVALS_TEXT = {**_evaluated("TEMOS", "MotionCLIP", "TM2T"), "UDE": "evaluate"}
RIVALS_MUSIC = {**_evaluated("FACT", "Bailando"), "UDE": "evaluate_dances"}


def _of(prefix: str, stages: Mapping[str, str], answers: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    rows = {title: (prefix + stage, MODEL) for title, stage in stages.items()}
    first = prefix + next(iter(stages.values()))
    return rows | {title: (first, row) for title, row in answers.items()}


TABLES = {
    "rivals": Table(
        "Captions, whole bodies: Table 1",
        _of("", RIVALS, ANSWERS),
        (
            Column("FID", "evaluator.fid", 2),
            Column("R-Precision, top 3", "evaluator.top-3", 3),
            Column("TMA-R-Precision ({candidates}), top 3", "tma.m2t_r3", 3),
            Column("Matching", "evaluator.matching_score", 2),
            Column("MModality", "evaluator.multimodality", 2),
            Column("everything right, %", "agreement.everything", 0, 100),
            Column("jitter", "physics.jitter", 2),
        ),
    ),
    "rivals_ude_text": Table("UDE's Table 1", _of("", RIVALS_TEXT, ANSWERS), TEXT),
    "rivals_ude_music": Table(
        "UDE's Table 2",
        _of("", RIVALS_MUSIC, {"recorded": RECORDED, "nearest training music": NEAREST_MUSIC}),
        MUSIC,
    ),
    "ude_codebook": Table(
        "Codebooks of 512 codes, 1,000 steps of 32 windows",
        {
            "moving averages [ours]": ("codes_ema", MODEL),
            "gradient, from the first batch [ours]": ("codes_gradient_data", MODEL),
            "gradient, from ± 1/K (the paper)": ("codes_gradient", MODEL),
            "nearest training clip": ("codes_ema", "nearest training clip"),
            "mean pose": ("codes_ema", "mean pose, still"),
        },
        (
            Column("MPJPE, mm", "reconstruction.mpjpe"),
            Column("pose, mm", "reconstruction.pose"),
            Column("in the world, mm", "reconstruction.world", 0),
            Column("codes in a batch, %", "log:train/usage_code", 0, 100),
        ),
    ),
    "ude_variants_text": Table("Tables 3 to 5, captions", _of("text_", VARIANTS, ANSWERS), TEXT),
}  # fmt: skip
COMMANDS = {
    "rivals": "motionloom run baselines-tiny",
    **dict.fromkeys(("rivals_ude_text", "rivals_ude_music"), "motionloom run baselines-tiny-ude"),
}
"""The command that was run before `--collect`; otherwise the script of UDE's ingredients."""


PROTOCOL = ("split", "clips", "songs", "repeats", "decodings", "lengths", "seed_motion", "reference", "steps")
"""Facts that a record keeps, beside settings of sampling; steps are those of the training."""


def collect(runs: Sequence[Path], names: Iterable[str]) -> None:
    """Write a record of each of these tables of which a stage has finished, one value for each run."""
    for name in names:
        table = TABLES[name]
        rows = [merged([row_of(run, table, title) for run in runs]) for title in table.rows]
        if rows := [row for row in rows if row["cells"]]:
            command = COMMANDS.get(name, "python benchmarks/ude_ingredients.py CLIPS WORK")
            report(table.title, table.columns, rows, name, command + f", {len(runs)} runs" * (len(runs) > 1))


def merged(rows: Sequence[Record]) -> Record:
    """One row of those of several runs: their values and seeds in turn; facts that differ, joined."""
    rows = [row for row in rows if row["cells"]] or list(rows[:1])
    out = rows[0] | {"seeds": [seed for row in rows for seed in row["seeds"]], "cells": {}}
    for row in rows:
        for figure, values in row["cells"].items():
            out["cells"].setdefault(figure, []).extend(values)
    for key in ("candidates", "protocol"):
        names = dict.fromkeys(name for row in rows for name in row[key])
        facts = {name: dict.fromkeys(row[key].get(name) for row in rows) for name in names}
        out[key] = {k: next(iter(v)) if len(v) == 1 else " and ".join(map(str, v)) for k, v in facts.items()}
    return out


def row_of(run: Path, table: Table, title: str) -> Record:
    """The cells of a row, one value for each seed that has finished, and how it was measured."""
    stage, row = table.rows[title]
    cells: dict[str, list[float]] = {}
    seeds = []
    protocol = {}
    candidates = {}
    variant = list[str]()
    code = dict[str, int]()
    settings = dict[str, str]()
    for seed in SEEDS if row == MODEL else SEEDS[:1]:
        folder = run / "stages" / f"{stage}_{seed}"
        if seed == SEEDS[0] and (run / "stages" / stage).is_dir():  # of a recipe that has one
            folder = run / "stages" / stage
        if not (folder / "artifact.json").is_file():
            continue
        found = FigureFile.read(folder / FILE_NAME) if (folder / FILE_NAME).is_file() else None
        seeds.append(found.about.get("seed", seed) if found else seed)
        for column in table.columns:
            value = logged(run, stage, seed, column) if row == MODEL else None
            figure = found.of(column.figure, row) if found else None
            if figure is not None:
                value = figure.value
                protocol = {**protocol, **figure.protocol}
                if "candidates" in figure.protocol:
                    candidates[column.figure] = figure.protocol["candidates"]
            if value is not None:
                cells.setdefault(column.figure, []).append(value)
        if found and row == MODEL:
            records = finished_records(run)
            model = records.get(found.about.get("made_by", {}).get("generator", ""))
            own = records.get(folder.name)
            protocol |= {"steps": steps_of(model or (own.inputs.get("tokenizer") if own else None))}
            for made in (own, model):
                for one in (made, *made.upstream()) if made else ():
                    code[one.kind] = one.version
                    settings[one.name] = settings_digest(one.kind, one.config)
            variant = unlike_published(model.kind, model.config) if model else []
    drawn = {k: v for k, v in protocol.items() if k in PROTOCOL or k.startswith("sampling")}
    facts = {"protocol": drawn, "candidates": candidates, "variant": variant, "code": code}
    facts |= {"recipe": read_yaml(run / "recipe.yaml")["name"], "settings": settings}
    return {"title": title, "cells": cells, "seeds": seeds if row == MODEL else [], **facts}


def steps_of(model: StageRecord | None) -> str | int:
    """Steps of a generator's training, or of those of the networks that it is made of."""
    parts = {"": model, **model.inputs} if model else {}
    each = {role: flatten(part.config).get("train.steps") for role, part in parts.items() if part}
    said = [f"{steps} ({role})" for role, steps in each.items() if role and steps]
    return each.get("") or " and ".join(said) or "not recorded"


def unlike_published(kind: str, config: Mapping[str, object]) -> list[str]:
    """Choices of a network, sizes aside, other than its kind's and the published norm behind the sums."""
    usual = flatten(stage_kinds()[kind].config().dump()) | {"net.norm": "post"}
    own = flatten(config)
    chosen = [key for key in own if key.startswith("net.") and usual.get(key) != own[key]]
    return [f"{key.split('.')[-1]} {own[key]}".lower() for key in chosen if isinstance(own[key], str | bool)]


def logged(run: Path, stage: str, seed: int, column: Column) -> float | None:
    """The last logged value of the training that a stage of figures measures: a mean of five."""
    kind, _, name = column.figure.partition(":")
    if kind != "log":
        return None
    path = run / "stages" / f"{stage.removeprefix('codes_')}_{seed}" / "metrics.jsonl"
    values = [json.loads(line).get(name) for line in path.read_text().splitlines()]
    last = [value for value in values if value is not None][-5:]
    return sum(last) / len(last) if last else None


def page(text: str, records: Mapping[str, Record]) -> str:
    """The page with the table of each record that it names."""
    return TABLE.sub(lambda found: found[1] + table_of(records[found[2]]) + "\n", text)


def read_records() -> dict[str, Record]:
    """The records that are tables, by name."""
    found = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in RECORDS.glob("*.json")}
    return {name: record for name, record in found.items() if "rows" in record}


def rendered() -> str:
    return page(PAGE.read_text(encoding="utf-8"), read_records())


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--collect", type=Path, nargs="+", help="folders of runs of one recipe")
    parser.add_argument(
        "--tables", nargs="+", choices=TABLES, default=list(TABLES), help="which records are made of it"
    )
    args = arguments(parser)
    if args.collect is not None:
        collect(args.collect, args.tables)
    PAGE.write_text(rendered(), encoding="utf-8")


if __name__ == "__main__":
    main()
