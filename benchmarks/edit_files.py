"""How edited clips come out of the files that are written: bones, kept frames and pins, by this file's own
forward kinematics of BVH.

    python benchmarks/edit_files.py inbetween walk.npz walk.bvh

Of each clip the middle 40 % is made again: alone, with the left wrist pinned in its middle 5 and 30 cm above
where it was, and 50 m away. Files are written with the clip's own beside them and compared with that.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from bench import arguments, command_line
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.editing import EditTask
from motionloom.pipeline.inference.edits.clip_file import read_clip
from motionloom.pipeline.inference.edits.frames import edit_frames
from motionloom.pipeline.inference.model import MotionModel, original_of

GAP = (0.3, 0.7)
PINS = {"no pin": None, "5 cm up": (0, 0.05, 0), "30 cm up": (0, 0.3, 0), "50 m away": (0, 0, 50)}
ELBOW, WRIST = "left_elbow", "left_wrist"


def turn(axis: str, degrees: float) -> NDArray[np.float64]:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    rows = {"X": [[1, 0, 0], [0, c, -s], [0, s, c]], "Y": [[c, 0, s], [0, 1, 0], [-s, 0, c]]}
    return np.array(rows.get(axis, [[c, -s, 0], [s, c, 0], [0, 0, 1]]))


def positions(path: Path) -> tuple[list[str], NDArray[np.float64]]:
    """Names, and positions [T, N, 3] in metres, of the joints of a BVH file in centimetres."""
    head, _, body = path.read_text(encoding="utf-8").partition("MOTION")
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float]] = []
    channels: list[list[str]] = []
    above, ended = [-1], False
    for line in map(str.split, head.splitlines()):
        if line[:1] in (["ROOT"], ["JOINT"]):
            names.append(line[1])
            parents.append(above[-1])
        ended = line[:1] == ["End"] or (ended and line != ["}"])
        if line[:1] == ["OFFSET"] and not ended:
            offsets.append([float(value) for value in line[1:]])
        elif line[:1] == ["CHANNELS"]:
            channels.append(line[2:])
        elif line == ["{"]:
            above.append(len(names) - 1)
        elif line == ["}"]:
            above.pop()
    rows = [[float(value) for value in line.split()] for line in body.strip().splitlines()[2:]]
    out = np.empty((len(rows), len(names), 3))
    for frame, row in enumerate(rows):
        values, world = iter(row), []
        for joint, parent in enumerate(parents):
            place, own = np.array(offsets[joint]), np.eye(3)
            for channel in channels[joint]:
                value = next(values)
                if channel.endswith("position"):
                    place["XYZ".index(channel[0])] = value
                else:
                    own = own @ turn(channel[0], value)
            base, carried = (np.zeros(3), np.eye(3)) if parent < 0 else (out[frame, parent], world[parent])
            out[frame, joint] = base + carried @ place
            world.append(carried @ own)
    return names, out / 100


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("model", type=Path, help="an exported folder, or the name of a model of the package")
    parser.add_argument("clips", nargs="+", type=Path, help="clips to edit: .bvh, .npz, .glb")
    args = arguments(parser)
    model = MotionModel(args.model, "cpu")
    table = Table("clip", "pin", "kept, cm (mean, most)", "pin off, cm", "forearm, cm", "it says")
    for clip in args.clips:
        with tempfile.TemporaryDirectory() as folder:
            one = replace(read_clip(clip), bvh=None)
            clip_itself = original_of(edit_frames(EditTask(), one, model.bundle.layout), one)
            names, own = positions(clip_itself.save(Path(folder) / "before.bvh"))
        start, stop = (round(share * len(own)) for share in GAP)
        middle, keep = (start + stop) // 2, [{"end": start / model.fps}, {"start": stop / model.fps}]
        for title, away in PINS.items():
            task: dict[str, object] = {"keep": keep}
            wanted = own[middle, names.index(WRIST)] + (away or (0, 0, 0))
            if away is not None:
                task["pins"] = [{"at": middle / model.fps, "joint": WRIST, "position": wanted.tolist()}]
            try:
                made = replace(model.edit(clip, task)[0], bvh=None)  # on the joints that are named here
            except UserError as error:
                table.add_row(clip.name, title, "", "", "", str(error)[:80])
                continue
            with tempfile.TemporaryDirectory() as folder:
                _, found = positions(made.save(Path(folder) / "after.bvh"))
            body = [names.index(joint) for joint in Skeleton.named("smpl22").joints]  # fingers may be new
            kept = np.r_[0:start, stop : min(len(own), len(found))]
            off = 100 * np.linalg.norm(found[kept][:, body] - own[kept][:, body], axis=-1)
            wrist, elbow = (found[:, names.index(joint)] for joint in (WRIST, ELBOW))
            fore = 100 * np.linalg.norm(wrist - elbow, axis=-1)
            miss = 100 * np.linalg.norm(wrist[middle] - wanted)
            told = [
                f"{off.mean():.2f}, {off.max():.2f}",
                f"{miss:.1f}",
                f"{fore.min():.1f} to {fore.max():.1f}",
            ]
            table.add_row(clip.name, title, *told, "; ".join(made.report.lines()[:2]))
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
