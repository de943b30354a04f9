"""The page of `motionloom data clean`: each suspect clip moves, with what is wrong with it, and one decides.

The page saves the decisions as a file, which `motionloom data clean SHARDS --decisions FILE` adds to the data
set. A clip that is another one again stands beside that one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from motionloom.datasets.base.printable import printable
from motionloom.datasets.base.records import Decisions
from motionloom.pipeline.curation.suspects import Place, Splits, Suspect, find_suspects, open_splits, ranked
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.render.viewer import ViewerMotion
from motionloom.pipeline.results.data_page import watch

BEFORE, SECONDS = 1.5, 5.0
"""The page shows `SECONDS` of a clip, from `BEFORE` seconds before its fault."""
DECISIONS = "decisions.json"


def suspects_of(root: Path, model: str | None = None, *, progress: bool = False) -> dict[Place, Suspect]:
    """Undecided suspects of the data set in `root`, worst first; with a model also by captions."""
    kept = Decisions.of(root).kept
    suspects = find_suspects(open_splits(root), kept, progress=progress)
    if model is None:
        return suspects
    from motionloom.pipeline.curation.search import Search

    search = Search.open(root, model, progress=progress)
    by_id = {suspect.id: suspect for suspect in suspects.values()}
    for place, fault in search.misfits():
        clip = search.splits[place.split].ids[place.clip]
        if clip not in kept and clip not in search.excluded:
            before = by_id.get(clip) or Suspect(place, clip, ())
            by_id[clip] = replace(before, faults=(*before.faults, fault))
    return ranked(by_id.values())


def kinds_of(suspects: Mapping[Place, Suspect]) -> dict[str, int]:
    """Number of suspects of each kind, by their worst fault."""
    return dict(Counter(suspect.faults[0].kind for suspect in suspects.values()).most_common())


def write_clean_page(root: Path, out: Path, suspects: Mapping[Place, Suspect], clips: int) -> None:
    """Write the page about the worst `clips` of the suspects of the data set in `root` to the file `out`."""
    splits = open_splits(root)
    name = next(iter(splits.values())).manifest.name
    page = Page(f"Suspect clips of {name}", "Decide, save, and give the file to: data clean --decisions FILE")
    kinds = kinds_of(suspects)
    shown = sorted(list(suspects.values())[:clips], key=lambda each: list(kinds).index(each.faults[0].kind))
    facts = {"clips": sum(map(len, splits.values())), "suspects": len(suspects), "shown": len(shown)}
    page.add_facts({**facts, **kinds})
    if not shown:
        page.add_text("Nothing looks wrong.").write(out)
        return
    motions: list[ViewerMotion] = []
    choices: list[tuple[str, str] | None] = []
    for suspect in shown:
        kind = suspect.faults[0].kind
        reasons = "; ".join(fault.text for fault in suspect.faults)
        begin = 0 if suspect.twin else suspect.faults[0].frame
        motions.append(replace(_seen(splits, suspect.place, begin), group=kind))
        choices.append((suspect.id, printable(reasons)))
        if suspect.twin is not None:
            motions.append(replace(_seen(splits, suspect.twin, 0), group=kind))
            choices.append(None)
    page.add_viewer(motions, "A clip without buttons is the one that the clip before it is again.")
    page.add_choices(choices, DECISIONS).write(out)


def _seen(splits: Splits, place: Place, frame: int) -> ViewerMotion:
    dataset = splits[place.split]
    start = max(0, frame - round(BEFORE * dataset.layout.fps))
    return watch(dataset, place.clip, start=start, seconds=SECONDS)
