"""How every script of this folder reads its arguments, trains, times, prints and records.

A script fills rows and calls `report`: the same Markdown is printed and, by `--record NAME`, stands in
`benchmarks/records/NAME.json` with its command, versions and cost, from where `results.py` takes it.
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import shlex
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

from motionloom.datasets.actions.measure import agrees
from motionloom.datasets.base.files import write_json
from motionloom.pipeline.contract.fingerprint import fingerprint_fields
from motionloom.pipeline.contract.stage import KINDS, stage_kinds
from motionloom.pipeline.evaluation.estimate import estimate
from motionloom.pipeline.evaluation.truth import Truth
from motionloom.pipeline.inference.shipped_models import CARD_FIGURES
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.layers import shipped_recipes
from motionloom.pipeline.runs.plan import Selection
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.store.yaml import dump_yaml

HERE = Path(__file__).resolve().parent
WEIGHTS = "model.safetensors"
RECORDS = HERE / "records"
SEEDS = (7, 8, 9)
"""Seeds of a full table; a row of fewer says how many."""
OFF = {"sampling.top_k": 0, "sampling.cfg_scale": 1.0, "sampling.candidates": 1}
"""Values of sampling settings that leave the distribution as it is."""
Record = dict[str, Any]
Shares = dict[str, dict[str, float]]
"""Held out or not -> attribute -> share of right ones."""
Judged = tuple[NDArray[Any], NDArray[Any] | None]
"""Joints [T, N, 3] and expression [T, 50], or None."""


class Column(NamedTuple):
    """A figure of `metrics.json`, scaled and with so many digits; `log:` names one of `metrics.jsonl`."""

    title: str
    figure: str
    digits: int = 1
    scale: float = 1.0


def command_line(doc: str | None) -> argparse.ArgumentParser:
    """A parser whose help is the script's docstring, with the options that all scripts share."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    parser.add_argument("--record", help="write benchmarks/records/NAME.json")
    return parser


def arguments(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The command's arguments; torch computes on as many threads as they say from here on."""
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    return args


def train(
    folder: Path, stages: Mapping[str, Any], *, until: str | None = None, force: bool = False, **fields: Any
) -> Path:
    """Run a recipe of these stages in `folder`, whose name it gets, on a GPU where there is one; finished
    stages are not repeated.
    """
    path = folder.parent / f"{folder.name}.yaml"
    path.parent.mkdir(parents=True, exist_ok=True)
    hardware = {"threads": torch.get_num_threads()}
    path.write_text(dump_yaml({"name": folder.name, "hardware": hardware, **fields, "stages": dict(stages)}))
    select = Selection(first=until, until=until) if force else Selection(until=until)
    return run_recipe(path, folder, select=select, replace=True, console=Console())


def kept(path: Path, measure: Callable[[], Any]) -> Any:
    """The JSON value in `path`, measured and written first where it is missing: a killed script goes on."""
    if not path.is_file():
        write_json(path, measure())
    return json.loads(path.read_text(encoding="utf-8"))


def cpu_seconds(calls: Mapping[str, Callable[[], object]], rounds: int = 7) -> dict[str, float]:
    """Median CPU seconds of each call, own and of child processes.

    The calls take turns, so that a slow phase of the machine meets all of them; the first round fills caches.
    """
    seconds: dict[str, list[float]] = defaultdict(list)
    for turn in range(rounds + 1):
        for name, call in calls.items():
            begin = process_seconds()
            call()
            if turn:
                seconds[name].append(process_seconds() - begin)
    return {name: statistics.median(values) for name, values in seconds.items()}


def process_seconds() -> float:
    """CPU seconds that this process and its finished children have used."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def judge(
    truths: Sequence[Truth], motions: Iterable[Judged], fps: float, hold_out: Sequence[Mapping[str, Any]]
) -> Shares:
    """Shares of right attributes; "shape" is of hands that are not relaxed, "every" all attributes together,
    "whole" the share of clips that get all right."""
    rows: dict[str, dict[str, list[bool]]] = {"held out": defaultdict(list), "other": defaultdict(list)}
    for truth, (joints, face) in zip(truths, motions, strict=True):
        record = truth.truth or {}
        apart = any(all(record.get(k) == v for k, v in c.items()) for c in hold_out)
        kind = rows["held out" if apart else "other"]
        right = agrees(record, joints, face, fps)
        for name, value in right.items():
            kind[name].append(value)
            kind["every"].append(value)
            if name.endswith("_hand") and record[name] != "relaxed":
                kind["shape"].append(value)
        kind["whole"].append(all(right.values()))
    return {kind: {name: float(np.mean(v)) for name, v in found.items()} for kind, found in rows.items()}


def report(
    title: str,
    columns: Sequence[Column],
    rows: Sequence[Record],
    name: str | None,
    command: str | None = None,
) -> None:
    """Print the table of rows and, where it has a name, write its record."""
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, cwd=HERE)
    versions = {package: version(package) for package in ("torch", "numpy")}
    record = {
        "measured": f"{datetime.now(UTC):%Y-%m-%d}",
        "commit": commit.stdout.decode().strip(),
        "command": command or f"python benchmarks/{Path(sys.argv[0]).name} {shlex.join(sys.argv[1:])}",
        "versions": {"python": platform.python_version()} | versions,
        "cpu_seconds": round(process_seconds()),
        "device": torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU",
        "code": {kind.name: kind.version for kind in KINDS.imported()},
        "title": title,
        "columns": [column._asdict() for column in columns],
        "rows": list(rows),
    }
    if name is not None:
        path = RECORDS / f"{name}.json"
        path.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        print(path)
    print(f"{title}\n\n{table_of(record)}")


def making(run: Path) -> Record:
    """How the weights of a finished run were made: day, versions, hours, steps and sums, for a model's card.

    Hours are of the stages' wall time, each as its run noted it, on as many processes as `hardware` says.
    """
    stages = sorted((run / "stages").glob("*/artifact.json"))
    times = [json.loads(path.with_name("timing.json").read_text()) for path in stages]
    facts = [json.loads(path.read_text(encoding="utf-8")) for path in stages]
    return {
        "day": f"{datetime.fromtimestamp(max(path.stat().st_mtime for path in stages), UTC):%Y-%m-%d}",
        "versions": {package: version(package) for package in ("torch", "numpy")},
        "hardware": max(times, key=lambda one: float(one["seconds"]))["hardware"],
        "hours": round(sum(one["seconds"] for one in times) / 3600, 1),
        "steps": {
            fact["stage"]: fact["config"]["train"]["steps"] for fact in facts if "train" in fact["config"]
        },
        "sha256": {
            fact["stage"]: fact["outputs"][WEIGHTS]["sha256"] for fact in facts if WEIGHTS in fact["outputs"]
        },
    }


def made_by(made: Mapping[str, Any]) -> str:
    """A card's sentence on how its weights were made; empty where nobody noted it."""
    if not made:
        return ""
    steps = ", ".join(f"{name} {count:,}" for name, count in made["steps"].items())
    used = ", ".join(f"{name} {number}" for name, number in made["versions"].items())
    return (
        f"Made by that on {made['day']} in {made['hours']:g} hours on {made['hardware']}, {used}. "
        f"Steps: {steps}. "
        f"`{CARD_FIGURES}` has the sha256 of each network as it was trained, before `--half`.\n"
    )


def table_of(record: Record) -> str:
    """A record as Markdown, with its protocol below."""
    columns = record["columns"]
    head = [record.get("corner", ""), *(_title(column, record["rows"]) for column in columns)]
    lines = []
    for row in record["rows"]:
        cells = [shown(row["cells"].get(column["figure"], ""), column) for column in columns]
        count = len(row.get("seeds", []))
        short = f" ({count} seed{'s' * (count > 1)})" if 0 < count < len(SEEDS) else ""
        variant = f" [{', '.join(row['variant'])}]" if row.get("variant") else ""
        lines.append([row["title"] + variant + short, *cells])
    return markdown(head, lines) + _older(record) + _protocol(record)


def older_rows(record: Record) -> dict[str, str]:
    """Title of each row that today's code would measure otherwise -> of which kinds or settings it is.

    A row knows the versions of the kinds that it measured, or else the record those that its script used, and
    of a run of a shipped recipe the settings of its stages.
    """
    out = {}
    for row in record["rows"]:
        code = row.get("code", record.get("code"))
        if code is None and "seeds" in row:  # of trainings, measured before records knew their code
            out[row["title"]] = f"of commit {record.get('commit', 'unknown')}"
            continue
        versions = {kind: found for kind, found in (code or {}).items() if _version(kind) != found}
        changed = [f"{kind} {found}, now {_version(kind)}" for kind, found in versions.items()]
        now = settings_now(row["recipe"]) if row.get("recipe") in shipped_recipes() else {}
        others = [name for name, found in row.get("settings", {}).items() if now and now.get(name) != found]
        if changed := changed + ([f"settings of {', '.join(others)}"] if others else []):
            out[row["title"]] = ", ".join(changed)
    return out


def settings_digest(kind: str, config: Mapping[str, object]) -> str:
    """A digest of the settings that decide what a stage makes, with today's defaults."""
    read = stage_kinds()[kind].config.parse(dict(config), kind)
    text = json.dumps(fingerprint_fields(read), sort_keys=True, default=str)
    return sha256(text.encode()).hexdigest()[:12]


@cache
def settings_now(recipe: str) -> dict[str, str]:
    """The digest of each stage of a shipped recipe."""
    stages = load_recipe(recipe, strict=False).stages
    return {stage.name: settings_digest(stage.kind.name, stage.config.dump()) for stage in stages}


def _version(kind: str) -> int:
    """Today's version of a kind; 0 where there is none of that name any more."""
    return stage_kinds()[kind].version if kind in stage_kinds() else 0


def _older(record: Record) -> str:
    """A line below the table that names the rows of older code."""
    groups: dict[str, list[str]] = defaultdict(list)
    for title, why in older_rows(record).items():
        groups[why].append(title)
    names = [
        why if len(titles) == len(record["rows"]) else f"{', '.join(titles)} ({why})"
        for why, titles in groups.items()
    ]
    return f"\n\n*Of older code: {'; '.join(names)}.*" if names else ""


def _title(column: Mapping[str, Any], rows: Sequence[Record]) -> str:
    """A column's title, with the candidates among which the rows were measured."""
    found = (row.get("candidates", {}).get(column["figure"]) for row in rows)
    among = dict.fromkeys(str(one) for one in found if one is not None)
    return str(column["title"]).format(candidates=" and ".join(among) or "not recorded")


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table as Markdown."""
    lines = ["| " + " | ".join(row) + " |" for row in (head, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]])


def shown(values: Any, column: Mapping[str, Any]) -> str:
    """A cell: text as it is, a value, both of two seeds, or the mean over seeds with its 95 % interval."""
    if not isinstance(values, list):
        return str(values)
    digits = column["digits"]
    found = estimate([column["scale"] * value for value in values])
    if found.pair:
        return " / ".join(f"{value:.{digits}f}" for value in found.pair)
    half = "" if found.interval is None else f" ± {found.interval:.{digits}f}"
    return f"{found.value:.{digits}f}{half}"


def _protocol(record: Record) -> str:
    """How the rows were measured: what they share, then what each group of rows has of its own."""
    each = {row["title"]: dict(row["protocol"]) for row in record["rows"] if row.get("protocol")}
    if not each:
        return ""
    undrawn = [row["title"] for row in record["rows"] if not row.get("seeds") and row["title"] in each]
    for title in undrawn:  # recordings and nearest clips, of which sampling settings say nothing
        each[title] = {key: value for key, value in each[title].items() if not key.startswith("sampling.")}
    first = next(iter(each.values()))
    common = {key: value for key, value in first.items() if all(
        own.get(key, value if title in undrawn else None) == value for title, own in each.items()
    )}  # fmt: skip
    groups: dict[str, list[str]] = defaultdict(list)
    for title, own in each.items():
        groups[_facts({k: v for k, v in own.items() if k not in common})].append(title)
    parts = [_facts(common), *(f"{' and '.join(titles)}: {own}" for own, titles in groups.items() if own)]
    device = record.get("device", "CPU")
    parts += [record.get("completed", ""), "" if device == "CPU" else f"on {device}"]
    return f"\n\n*Measured {record.get('measured', 'now')}: {'; '.join(part for part in parts if part)}.*"


def _facts(facts: Mapping[str, Any]) -> str:
    """Settings in words, without those that change nothing."""
    return ", ".join(
        f"{name.removeprefix('sampling.')} {value}"
        for name, value in facts.items()
        if str(value) != "{}" and OFF.get(name) != value
    )
