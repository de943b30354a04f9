"""Options of a BVH conversion, and a clip of its plan."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import ClassVar, Literal

from pydantic import Field

from motionloom.datasets.base.records import Caption, Split
from motionloom.datasets.convert.bvh.read import FoundFile, list_files, read_file, read_motion
from motionloom.datasets.convert.captions.humanml_index import HumanmlConfig
from motionloom.datasets.convert.common.facts import Fact, Facts
from motionloom.datasets.convert.common.tables import BadRows
from motionloom.datasets.motion.bvh.joint_map import Unit, Up
from motionloom.datasets.motion.bvh.motion import BvhMotion
from motionloom.datasets.motion.skeleton import Skeleton


class BvhConfig(HumanmlConfig):
    """Options of the BVH converter."""

    layouts = ("body133", "wholebody313", "wholebody363", "h3d263", "tomato623")
    everyday: ClassVar[tuple[str, ...]] = ("captions", "licence")

    source: Path
    """A folder of .bvh or .amc files, or one such file."""
    joint_map: Path | Literal["auto"] = "auto"
    """A JSON file that says which joints of the files stand for ours, or a folder of such files, each for its
    own skeleton (docs/sources.md). Where none fits, and with `auto`, the map is guessed from the names."""
    name: str = "bvh"
    licence: str | None = None
    """Licence of the clips, kept in every sample; needed for a conversion, not for its plan. HumanML3D's
    originals have their own; it then says which of them are converted."""
    layout: str = "body133"
    """Feature layout of the shards: body133, h3d263, or one with hands and a face."""
    fps: float = Field(default=20.0, gt=0, le=240)
    source_fps: float | None = Field(default=None, ge=1, le=10_000)
    """True frame rate of the files, for collections that state a wrong one."""
    unit: Unit | Literal["auto"] = "auto"
    """Length unit of the files: by the size of the bodies (`auto`), a name, or metres (`0.0564`)."""
    up: Up | Literal["auto"] = "auto"
    """Upward axis of the files; `auto`: where the heads are."""
    retarget: bool = False
    """Give every clip the bone lengths of the layout's skeleton."""
    fingers: Literal["recorded", "resting", "missing"] = "recorded"
    """For layouts with hands: the files have them (`recorded`, which needs a joint map with fingers); they
    have none, and each clip gets hands at rest, which count as motion (`resting`) or do not (`missing`).
    """

    def files(self) -> tuple[Path, list[str]]:
        """A folder, and the motion files in it by name."""
        return list_files(self.source)

    def about(self, path: str) -> Facts:
        """Facts of a file in the set's metadata; none for plain folders."""
        return {}

    @property
    def bad_rows(self) -> BadRows:
        """What is wrong with rows of the set's tables, by the names of their files, or by their places."""
        return {}

    def unfit(self, path: str) -> str:
        """Return the reason that the set's lists leave a file out; empty when they do not."""
        return ""

    def cut(self, label: str) -> slice:
        """The frames of a file that are its clip."""
        return slice(None)

    def mapped_skeleton(self) -> Skeleton:
        """The skeleton that the joint map reads: without fingers where the files have none."""
        own = self.motion_layout().skeleton
        return own if self.fingers == "recorded" else Skeleton.named("smpl22")


@dataclass(frozen=True)
class BvhClip:
    """A clip of the plan."""

    folder: Path
    found: FoundFile
    id: str
    split: Split
    texts: tuple[Caption, ...]
    frames: int
    """Frames of the file that are used."""
    fps: float
    about: Facts
    licence: str | None = None
    span: tuple[int, int] | None = None
    """Frames [first, last) of the recording, an added pose in front of it apart; None: all."""
    mirror_of: str | None = None

    @property
    def file(self) -> str:
        return self.found.path

    @property
    def subset(self) -> str:
        """The folder at the top of the source that it lies in; empty for none."""
        folders = PurePosixPath(self.found.path).parts[:-1]
        return folders[0] if folders else ""

    @property
    def seconds(self) -> float:
        return self.frames / self.fps

    @property
    def facts(self) -> dict[str, Fact]:
        return {"subset": self.subset, "seconds": self.seconds, "fps": self.fps, **self.about}

    def label(self) -> str:
        return self.found.path if self.span is None else f"{self.found.path} ({self.id})"

    def read(self) -> BvhMotion:
        """Return the motion of its file."""
        path = self.found.path
        return read_motion(read_file(self.folder / path, path), path)
