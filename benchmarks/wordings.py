"""Do words work that training never showed? TMA's retrieval with known and with new wordings.

    python benchmarks/wordings.py LABELS --write-captions captions.jsonl --known first second
    motionloom run bvh-body --set data.captions=captions.jsonl --until tma ...
    python benchmarks/wordings.py LABELS --run runs/bvh-body --known first second --new third free

LABELS is a JSON lines file that names `id`, `content` and `style` of every clip, such as the
`captions.jsonl` of the real clips in docs/results.md. `wordings.json` beside this script holds the wordings
in tables: what may be said of each content and style, and how a sentence is put together. The first command
writes LABELS with other captions, four a clip, of the tables `--known` alone; a model that is trained on
those has never seen the others. The last one words every test clip anew, of the known tables and of each new
one by itself, and reports, of candidates in random batches:

- recall both ways, where only the clip's own row is right; beside it a guess, and a reader that knows content
  and style of every clip and guesses among those that have both: no reader of captions gets above that;
- how often the first motion found for a caption has the right content, style, and both;
- the same for clips whose pair of content and style is in no training clip (`unseen`), among the same
  candidates.

Mean ± 95 % interval over the seeds: each words the clips and draws the batches anew.
"""

from __future__ import annotations

import argparse
import json
import random
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from torch import Tensor

from motionloom.models.metrics.retrieval import ranks
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.estimate import estimate
from motionloom.pipeline.evaluation.figures import Estimate
from motionloom.pipeline.evaluation.retrieval import alignment_stage
from motionloom.pipeline.evaluation.truth import truth_of
from motionloom.pipeline.store.networks import embed_motions

TABLES = Path(__file__).with_name("wordings.json")
CAPTIONS = 4
"""Captions a clip that are written for training."""

SHOWN = (
    *("t2m R@1", "t2m R@3", "m2t R@1", "m2t R@3"),
    *("content", "style", "both", "unseen t2m R@1", "unseen both"),
)
"""Columns of the table."""

Wordings = Mapping[str, Any]
Label = tuple[str, str]
"""Content and style of a clip."""


def joined(tables: Mapping[str, Wordings], names: Sequence[str]) -> Wordings:
    """One table of all wordings of the named ones; the sentences are put together as in the first."""
    first = tables[names[0]]
    content: dict[str, dict[str, list[str]]] = {}
    style: dict[str, list[str]] = {}
    for name in names:
        for label, forms in tables[name]["content"].items():
            mine = content.setdefault(label, {"v": [], "ing": []})
            for form in mine:
                mine[form] = [*mine[form], *forms[form]]
        for label, phrases in tables[name]["style"].items():
            style[label] = [*style.get(label, []), *phrases]
    return {**first, "content": content, "style": style}


def caption(wordings: Wordings, label: Label, draw: random.Random) -> str:
    """One sentence about a content and a style, lower case."""
    content, style = label
    forms, phrases = wordings["content"][content], wordings["style"][style]
    choices = list(wordings["templates"])
    if style == "normal":  # what is normal need not be said
        choices += wordings["templates_plain"]
    usable = [t for t in choices if all(forms[form] for form in ("v", "ing") if "{" + form + "}" in t)]
    fields = {form: draw.choice(forms[form]) for form in ("v", "ing") if forms[form]}
    manner = draw.choice(phrases)
    fields |= {"S": draw.choice(wordings["subjects"]), "A": manner, "A_cap": manner}
    said: str = draw.choice(usable).format(**fields)
    return said.lower()


def write_captions(labels: Path, wordings: Wordings, target: Path) -> None:
    """The rows of `labels` with captions of these wordings, decided by each clip's id."""
    rows = [json.loads(line) for line in labels.read_text(encoding="utf-8").splitlines()]
    with target.open("w", encoding="utf-8") as file:
        for row in rows:
            draw, label = random.Random(row["id"]), (row["content"], row["style"])
            said = [caption(wordings, label, draw) for _ in range(CAPTIONS)]
            file.write(json.dumps({**row, "captions": said}, ensure_ascii=False) + "\n")


def read_labels(path: Path) -> dict[str, Label]:
    """Content and style by the clips' ids."""
    rows = (json.loads(line) for line in path.read_text(encoding="utf-8").splitlines())
    return {row["id"]: (row["content"], row["style"]) for row in rows}


def figures(
    text: Tensor, motion: Tensor, labels: Sequence[Label], unseen: NDArray[np.bool_], size: int, seed: int
) -> dict[str, float]:
    """Every share of one draw of batches of `size`: text, motion [N, Z], `labels` [N], `unseen` bool [N]."""
    text, motion = F.normalize(text.double(), dim=-1), F.normalize(motion.double(), dim=-1)
    content, style = (np.array([label[i] for label in labels]) for i in (0, 1))
    order = np.random.default_rng(seed).permutation(len(labels))
    found: dict[str, list[NDArray[Any]]] = {}
    rows = order[: len(order) // size * size].reshape(-1, size)
    for batch in rows:
        distance = -(text[batch] @ motion[batch].T)
        nearest = batch[distance.argmin(1).numpy()]
        same = (content[batch][:, None] == content[batch]) & (style[batch][:, None] == style[batch])
        scores = {
            "t2m R@1": ranks(distance).numpy() < 1,
            "t2m R@3": ranks(distance).numpy() < 3,
            "m2t R@1": ranks(distance.T).numpy() < 1,
            "m2t R@3": ranks(distance.T).numpy() < 3,
            "content": content[nearest] == content[batch],
            "style": style[nearest] == style[batch],
            "both": (content[nearest] == content[batch]) & (style[nearest] == style[batch]),
            "labels known R@1": 1 / same.sum(1),
            "guess content": (content[batch][:, None] == content[batch]).mean(1),
            "guess style": (style[batch][:, None] == style[batch]).mean(1),
            "guess both": same.mean(1),
        }
        for name, values in scores.items():
            found.setdefault(name, []).append(values)
    shares = {name: np.concatenate(values).astype(np.float64) for name, values in found.items()}
    new = unseen[rows.ravel()]
    picked = {f"unseen {name}": shares[name][new] for name in ("t2m R@1", "both", "labels known R@1")}
    return {name: float(values.mean()) for name, values in (shares | picked).items() if len(values)}


def measure(
    run: Path, stage: str | None, labels: dict[str, Label], wordings: Mapping[str, Wordings],
    *, size: int, seeds: int, split: str,
) -> dict[str, dict[str, Estimate]]:  # fmt: skip
    """Wording -> figure -> mean and interval over the seeds, of one TMA."""
    found, stage_cache = alignment_stage(run, stage), StageCache()
    tma, given = stage_cache.get(found), stage_cache.given(found.inputs)
    dataset = given["data"].split(split)
    truths = [truth_of(dataset, i) for i in range(len(dataset))]
    motion = embed_motions(tma, [t.features for t in truths], [t.present for t in truths])
    mine = [labels[t.id] for t in truths]
    trained = {labels[i] for i in given["data"].split("train").ids}
    unseen = np.array([label not in trained for label in mine])
    out = {}
    for name, table in wordings.items():
        rows = []
        for seed in range(seeds):
            draw = random.Random(seed)
            said = [caption(table, label, draw) for label in mine]
            encoded = [given["text"].encoder.encode(said[i : i + 64]) for i in range(0, len(said), 64)]
            text = torch.cat(
                [tma.embed_text(torch.from_numpy(e.tokens), torch.from_numpy(e.mask)).cpu() for e in encoded]
            )
            rows.append(figures(text, motion, mine, unseen, size, seed))
        out[name] = {key: estimate([row[key] for row in rows]) for key in rows[0]}
    return out


def report(found: Mapping[str, Mapping[str, Estimate]], size: int) -> Table:
    """One row a wording."""
    first = next(iter(found.values()))
    shown = [name for name in SHOWN if name in first]
    table = Table("wordings", *shown, title=f"among {size}", title_justify="left")
    guesses = {name: int(name[-1]) / size for name in shown if "R@" in name}
    guesses |= {name: first[f"guess {name}"].value for name in ("content", "style", "both")}
    best = dict.fromkeys(("t2m R@1", "m2t R@1"), first["labels known R@1"].value)
    if "unseen labels known R@1" in first:
        best["unseen t2m R@1"] = first["unseen labels known R@1"].value
    for title, values in (("a guess", guesses), ("labels known", best)):
        table.add_row(title, *(f"{values[name]:.3f}" if name in values else "" for name in shown))
    for name, row in found.items():
        table.add_row(name, *(f"{row[key].value:.3f} ± {row[key].interval or 0.0:.3f}" for key in shown))
    return table


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("labels", type=Path)
    parser.add_argument("--tables", type=Path, default=TABLES)
    parser.add_argument("--known", nargs="+", default=["first", "second"])
    parser.add_argument("--new", nargs="*", default=["third"])
    parser.add_argument("--write-captions", type=Path)
    parser.add_argument("--run", type=Path)
    parser.add_argument("--stage", nargs="+", help="stages that align text with motion; `tma` if not given")
    parser.add_argument("--split", default="test")
    parser.add_argument("--size", type=int, default=32)
    parser.add_argument("--seeds", type=int, default=3)
    args = parser.parse_args()
    tables = json.loads(args.tables.read_text(encoding="utf-8"))["tables"]
    for name in [*args.known, *args.new]:
        if name not in tables:
            parser.error(f"{args.tables}: no table '{name}'; it has {', '.join(tables)}")
    known = joined(tables, args.known)
    if args.write_captions is not None:
        write_captions(args.labels, known, args.write_captions)
    if args.run is None:
        return
    wordings = {"known": known, **{name: tables[name] for name in args.new}}
    console, results = Console(width=160), {}
    for stage in args.stage or [None]:
        labels, asked = (
            read_labels(args.labels),
            {"size": args.size, "seeds": args.seeds, "split": args.split},
        )
        found = measure(args.run, stage, labels, wordings, **asked)
        console.print(stage or "tma", report(found, args.size))
        results[stage or "tma"] = {
            name: {key: [value.mean, value.half_width] for key, value in row.items()}
            for name, row in found.items()
        }
    (args.run / "wordings.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
