"""100STYLE: a hundred styles of walking, running and standing; BVH at 60 fps, cut by Frame_Cuts.csv.

`STYLE/STYLE_MOVEMENT.bvh` in centimetres, and one row a style in `Frame_Cuts.csv` with the first and last
frame of every movement (`FW_START`, `FW_STOP`); what is before and after is the actor getting ready.
`Dataset_List.csv` describes the styles. Captions are made of movement and description.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path, PurePosixPath

from motionloom.datasets.convert.bvh.convert import Bvh
from motionloom.datasets.convert.bvh.plan import BvhConfig
from motionloom.datasets.convert.captions.options import Listing, list_clips
from motionloom.datasets.convert.captions.read import CaptionRow
from motionloom.datasets.convert.common.audit import Published
from motionloom.datasets.convert.common.splits import hash_split, read_split_files
from motionloom.datasets.convert.common.where import Facts
from motionloom.datasets.convert.sets.shared.tables import captions_of, read_csv
from motionloom.datasets.motion.bvh.joint_map import Unit, Up
from motionloom.datasets.schema import UserError

CUTS, STYLES = "Frame_Cuts.csv", "Dataset_List.csv"
MOVEMENTS = {
    "FW": "walks forward",
    "BW": "walks backward",
    "SW": "walks sideways",
    "FR": "runs forward",
    "BR": "runs backward",
    "SR": "runs sideways",
    "ID": "stands",
    "TR1": "changes between standing, walking and running",
    "TR2": "changes between standing, walking and running",
    "TR3": "changes between standing, walking and running",
}


class Style100Config(BvhConfig):
    """Options of the 100STYLE converter; `source` is the folder that holds Frame_Cuts.csv."""

    name: str = "100style"
    """Name of the data set; part of the shards' file names."""
    licence: str | None = "CC-BY-4.0"
    """Licence of the clips."""
    unit: Unit = "cm"
    """Length unit of the files."""
    up: Up = "y"
    """Upward axis of the files."""

    @property
    def has_captions(self) -> bool:
        return True

    def cut(self, label: str) -> slice:
        return _cuts(self.source).get(_stem(label), slice(None))

    def unfit(self, path: str) -> str:
        return "" if _stem(path) in _cuts(self.source) else f"no frames of it in {CUTS}"

    def about(self, path: str) -> Facts:
        style, _, movement = _stem(path).rpartition("_")
        return {"style": style, "movement": movement}

    def listing(self, paths: Sequence[str]) -> Listing:
        if self.captions is not None:
            return super().listing(paths)
        cuts, described = _cuts(self.source), _descriptions(self.source)
        rows = []
        for path in paths:
            style, _, movement = _stem(path).rpartition("_")
            words = _words(style)
            texts = []
            if movement in MOVEMENTS:
                texts = captions_of(f"a person {MOVEMENTS[movement]} in the style {words}", "style")
                about = described.get(words)
                texts += (
                    captions_of(f"a person {MOVEMENTS[movement]}: {about}", "description") if about else []
                )
            # New styles are for testing: clips of one style stay together.
            row = CaptionRow(_stem(path), tuple(texts), path, hash_split(style), False, None, path)
            rows.append(row)
        found = list_clips(paths, rows, read_split_files(self.splits)[0] if self.splits else None, [])
        found.missing.update({name: name for name in cuts.keys() - {_stem(path) for path in paths}})
        return found


class Style100(Bvh):
    """The 100STYLE converter."""

    name = "style100"
    title = "100STYLE"
    summary = "100STYLE: walks and runs in a hundred styles (BVH) to shards."
    example = "100STYLE shards"
    config_class = Style100Config
    published = Published("Zenodo record", {"clips": 810, "style": 100, "hours": 18.8})


def _stem(path: str) -> str:
    return PurePosixPath(path).stem


def _words(style: str) -> str:
    """`ArmsAboveHead` and `Arms Above Head` alike as `arms above head`."""
    spaced = "".join(f" {letter}" if letter.isupper() else letter for letter in style)
    return " ".join(spaced.lower().split())


@lru_cache(maxsize=4)
def _cuts(source: Path) -> dict[str, slice]:
    """First and last frame of every file that has them, by its name without suffix."""
    if not (source / CUTS).is_file():
        raise UserError(f"{source}: no {CUTS} in it; give the folder of the release")
    found = {}
    for row in read_csv(source / CUTS, ("STYLE_NAME",)):
        for movement in MOVEMENTS:
            start, stop = (row.get(f"{movement}_{end}", "").strip() for end in ("START", "STOP"))
            if start in ("", "N/A", "NA", "nan") or stop in ("", "N/A", "NA", "nan"):
                continue
            name = f"{row['STYLE_NAME'].strip()}_{movement}"
            try:
                found[name] = slice(int(float(start)), int(float(stop)))
            except ValueError:
                raise UserError(f"{CUTS}: {name}: frames '{start}' to '{stop}' are no numbers") from None
    return found


@lru_cache(maxsize=4)
def _descriptions(source: Path) -> dict[str, str]:
    if not (source / STYLES).is_file():
        return {}
    rows = read_csv(source / STYLES, ("Style Name", "Description"))
    return {_words(row["Style Name"]): row["Description"].strip().rstrip(".") for row in rows}
