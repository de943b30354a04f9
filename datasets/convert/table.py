"""The converters by name. A converter is imported when it is asked for, so `--help` stays quick."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from motionloom.datasets.schema import UserError

if TYPE_CHECKING:
    from motionloom.datasets.convert.common.config import ConvertConfig
    from motionloom.datasets.convert.common.conversion import Conversion


@dataclass(frozen=True)
class Converter:
    """One kind of source."""

    module: str
    """Module that holds the config class and the prepare function."""
    config_name: str
    prepare_name: str
    summary: str
    """One line for the help."""
    example: str
    """What follows `motionloom data convert NAME` in the example of the help."""
    reads_skeletons: bool = False
    """Whether prepare takes `scan`, a file that remembers what it found in files that have not changed, and
    `maps`, a folder for guessed joint maps."""
    features_first: bool = False
    """Whether its clips are decoded in a step of their own before the first shard (`Conversion.features`)."""

    def config(self) -> type[ConvertConfig]:
        """The config class."""
        found: type[ConvertConfig] = getattr(importlib.import_module(self.module), self.config_name)
        return found

    def prepare(
        self,
        config: ConvertConfig,
        *,
        out: Path | None = None,
        maps: Path | None = None,
        workers: int = 1,
        progress: bool = False,
    ) -> Conversion[Any]:
        """Look at the whole source and decide what becomes of every file.

        With `out`, the folder of the shards, a source whose listing must read every file (archives) is read
        once and not again by the next run or by the other parts of a conversion. Joint maps that are guessed
        are written into `maps`, by default `out`.
        """
        from motionloom.datasets.convert.common.conversion import SCAN_FILE

        prepare = getattr(importlib.import_module(self.module), self.prepare_name)
        more: dict[str, Any] = {}
        if self.reads_skeletons:
            more = {"scan": None if out is None else out / SCAN_FILE, "maps": maps or out}
        made: Conversion[Any] = prepare(config, workers=workers, progress=progress, **more)
        return made


_HERE = "motionloom.datasets.convert"

CONVERTERS: dict[str, Converter] = {
    "humanml3d": Converter(
        f"{_HERE}.humanml3d.convert",
        "HumanMl3dConfig",
        "prepare_humanml3d",
        "HumanML3D: new_joints or new_joint_vecs, texts and split files to shards.",
        "HumanML3D shards",
    ),
    "motionx": Converter(
        f"{_HERE}.motionx.convert",
        "MotionXConfig",
        "prepare_motionx",
        "Motion-X: SMPL-X parameters (322-d), body, hand and face texts to shards.",
        "Motion-X shards",
    ),
    "aistpp": Converter(
        f"{_HERE}.aistpp.convert",
        "AistppConfig",
        "prepare_aistpp",
        "AIST++: SMPL dances with their music to shards.",
        "aist_plusplus_final shards",
    ),
    "amass": Converter(
        f"{_HERE}.amass.convert",
        "AmassConfig",
        "prepare_amass",
        "AMASS: SMPL-H and SMPL-X .npz files to shards.",
        "AMASS shards",
    ),
    "bvh": Converter(
        f"{_HERE}.bvh.convert",
        "BvhConfig",
        "prepare_bvh",
        "BVH files of any skeleton, loose or in tar archives, to shards.",
        "mocap shards --captions captions.jsonl --licence CC-BY-4.0",
        reads_skeletons=True,
        features_first=True,
    ),
}


def converter_named(kind: str) -> Converter:
    """The table's entry; `UserError` with the known names otherwise."""
    if kind not in CONVERTERS:
        raise UserError(f"unknown converter '{kind}'; known: {', '.join(CONVERTERS)}")
    return CONVERTERS[kind]
