"""100STYLE: a hundred styles of walking, running and standing; BVH at 60 fps, cut by Frame_Cuts.csv.

`STYLE/STYLE_MOVEMENT.bvh` in centimetres, and one row a style in `Frame_Cuts.csv` with the first and last
frame of every movement (`FW_START`, `FW_STOP`); what is before and after is the actor getting ready.
`Dataset_List.csv` describes the styles. Captions are made of movement and description.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import whole
from motionloom.datasets.base.register import register
from motionloom.datasets.convert.bvh.convert import Bvh
from motionloom.datasets.convert.common.tables import BadRows, captions_of, read_csv, reading_row
from motionloom.datasets.convert.sets.bvh_sets import BvhSetConfig, Row, stem

CUTS = "Frame_Cuts.csv"
STYLES = "Dataset_List.csv"
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


class Style100Config(BvhSetConfig):
    """Options of the 100STYLE converter; `source` is the folder that holds Frame_Cuts.csv."""

    name: str = "100style"
    licence: str | None = "CC-BY-4.0"

    def cut(self, label: str) -> slice:
        return self.cuts.get(stem(label), slice(None))

    def unfit(self, path: str) -> str:
        return "" if stem(path) in self.cuts else self.bad_rows.get(stem(path), f"no frames of it in {CUTS}")

    @property
    def cuts(self) -> dict[str, slice]:
        """First and last frame of every file that has them, by its name without suffix."""
        return self.tables[0]

    @property
    def rows(self) -> dict[str, Row]:
        """Captions of every file that has frames. Clips of one style stay together: new styles are tested."""
        return self.tables[1]

    @property
    def bad_rows(self) -> BadRows:
        return self.tables[2]

    @cached_property
    def tables(self) -> tuple[dict[str, slice], dict[str, Row], BadRows]:
        """Both tables of the set."""
        bad: BadRows = {}
        cuts = _cuts(self.source, bad)
        return cuts, _rows(self.source, cuts, bad), bad


class Style100(Bvh):
    """The 100STYLE converter."""

    name = "style100"
    title = "100STYLE"
    summary = "100STYLE: walks and runs in a hundred styles (BVH) to shards."
    example = "100STYLE shards"
    config_class = Style100Config
    beside = (CUTS.lower(), STYLES.lower())
    credit = "Motion of 100STYLE (Mason, Starke and Komura, 2022), CC BY 4.0."
    published = "paper, 2022, and the list of files: 810 clips, 100 styles, 18.5 hours"


def _words(style: str) -> str:
    """`ArmsAboveHead` and `Arms Above Head` alike as `arms above head`."""
    spaced = "".join(f" {letter}" if letter.isupper() else letter for letter in style)
    return " ".join(spaced.lower().split())


def _cuts(source: Path, bad: BadRows) -> dict[str, slice]:
    if not (source / CUTS).is_file():
        raise UserError(f"{source}: no {CUTS} in it; give the folder of the release")
    found = {}
    for _, row in read_csv(source / CUTS, ("STYLE_NAME",), bad):
        for movement in MOVEMENTS:
            start, stop = (row.get(f"{movement}_{end}", "").strip() for end in ("START", "STOP"))
            if start in ("", "N/A", "NA", "nan") or stop in ("", "N/A", "NA", "nan"):
                continue
            name = f"{row['STYLE_NAME'].strip()}_{movement}"
            with reading_row(name, bad):
                found[name] = slice(*(whole(frame, f"{CUTS}: {name}: frames") for frame in (start, stop)))
    return found


def _rows(source: Path, cuts: Iterable[str], bad: BadRows) -> dict[str, Row]:
    there = (source / STYLES).is_file()
    styles = read_csv(source / STYLES, ("Style Name", "Description"), bad) if there else []
    described = {_words(row["Style Name"]): row["Description"].strip().rstrip(".") for _, row in styles}
    found = {}
    for name in cuts:
        style, _, movement = name.rpartition("_")
        words = _words(style)
        does = f"a person {MOVEMENTS[movement]}"
        texts = captions_of(f"{does} in the style {words}", "style")
        texts += captions_of(f"{does}: {described[words]}", "description") if words in described else []
        found[name] = Row(tuple(texts), style, {"style": style, "movement": movement})
    return found


register(Style100)
