"""GLB, VRM and VRMA -> shards: the animations of characters' files, each a clip; its name is its caption."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import ClassVar

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Caption
from motionloom.datasets.base.register import register
from motionloom.datasets.convert.bvh.config import BvhConfig
from motionloom.datasets.convert.bvh.convert import Bvh
from motionloom.datasets.convert.bvh.read import READERS
from motionloom.datasets.convert.captions.options import Listing, list_clips
from motionloom.datasets.convert.captions.read import CaptionRow
from motionloom.datasets.convert.common.files import walk_files
from motionloom.datasets.convert.common.splits import hash_split, read_split_files
from motionloom.datasets.motion.bvh.joint_map import Unit, Up
from motionloom.pipeline.inference.clip_file import ClipReader
from motionloom.pipeline.rigs.animations import ENDINGS, SUFFIX, clips_in, read_animation, read_character

READERS[SUFFIX] = read_animation
for _ending in (".vrm", ".vrma", SUFFIX):
    register(ClipReader(_ending, read_character))


class GlbConfig(BvhConfig):
    """Options of the GLB converter."""

    everyday: ClassVar[tuple[str, ...]] = ("captions", "licence")

    source: Path
    """A folder of .glb, .vrm or .vrma files, or one such file."""
    name: str = "glb"
    unit: Unit = "cm"
    """Length unit: clips are made as long as a grown person's, in centimetres."""
    up: Up = "y"
    """Upward axis, which is glTF's."""

    @cached_property
    def found(self) -> dict[str, str]:
        """Names of the clips in the source -> the names of their animations."""
        source = self.source
        root, names = (source.parent, [source.name]) if source.is_file() else (source, walk_files(source))
        out: dict[str, str] = {}
        for name in names:
            if name.lower().endswith(ENDINGS):
                folder = Path(name).parent.as_posix()
                inside = clips_in(root / name)
                out |= {
                    clip if folder == "." else f"{folder}/{clip}": words for clip, words in inside.items()
                }
        return out

    def files(self) -> tuple[Path, list[str]]:
        if not self.source.exists():
            raise UserError(f"{self.source}: no such file or folder")
        if not self.found:
            raise UserError(f"{self.source}: no {', '.join(ENDINGS)} file with an animation in it")
        return self.source.parent if self.source.is_file() else self.source, list(self.found)

    @property
    def has_captions(self) -> bool:
        return True

    def listing(self, paths: Sequence[str]) -> Listing:
        if self.captions:
            return super().listing(paths)
        rows = [
            CaptionRow(path, (Caption(text=words),), path, hash_split(Path(path).parent.as_posix()), path)
            for path, words in self.found.items()
            if path in paths and words
        ]
        return list_clips(paths, rows, read_split_files(self.splits) if self.splits else None, [])


class Glb(Bvh):
    """The converter of characters' animations."""

    name = "glb"
    title = "GLB and VRM animations"
    summary = "Animations of GLB, VRM and VRMA characters, hands included, to shards."
    example = "characters shards --licence CC0-1.0"
    config_class = GlbConfig


register(Glb)
