"""`motionloom search`: clips of a data set by words or by likeness."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.register import register
from motionloom.pipeline.cli.options import AsJson, print_json
from motionloom.pipeline.contract.command import Command
from motionloom.pipeline.launch.console import make_console, say

_CLIPS = 12
"""Clips that are listed."""


def search(
    root: Annotated[Path, typer.Argument(help="Folder with manifest.json.")],
    words: Annotated[str, typer.Argument(help="What the person does.")] = "",
    like: Annotated[
        str,
        typer.Option(help="A clip's id, or a file (.bvh; .npz or .glb of generate; .npy): clips like it."),
    ] = "",
    model: Annotated[
        str, typer.Option(help="Run, export or shipped model whose TMA reads words and motions.")
    ] = "synthetic",
    as_json: AsJson = False,
) -> None:
    """List the clips of a data set that are nearest to words, or to a clip.

    Embeddings of all clips are made once and kept beside the shards.

    Example: `motionloom search shards "turns left and waves"`

    Example: `motionloom search shards --like synth-0-000012`
    """
    console = make_console(aside=as_json)
    if bool(words) == bool(like):
        raise UserError("search: give words or --like, one of them")
    from motionloom.pipeline.curation.search import Search

    found = Search.open(root, model, progress=True)
    file = Path(like)
    if words:
        query = found.words(words)
    elif file.is_file():
        query = found.motion_file(file)
    else:
        query = found.clip(like)
    if words and math.isnan(found.precision):
        say(console, "note: no clip here has captions, so nobody knows whether this model can read them")
    hits = []
    for hit in found.best(query, _CLIPS, like):
        texts = found.splits[hit.place.split].texts(hit.place.clip)
        caption = texts[0].text if texts else ""
        say(console, f"{hit.score:5.2f}  {hit.place.split:5}  {hit.id}  {caption}")
        hits.append({"id": hit.id, "split": hit.place.split, "score": hit.score, "caption": caption})
    if as_json:
        print_json(hits)


register(Command("search", search))
