"""A conversion in parts, by processes of their own; and sources of which any file is damaged or misnamed."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path
from typing import Any

import amass_clips
import pytest
import release_trees
from bvh_clips import write_clip
from shard_samples import digests

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Manifest
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.registry import converter_named, prepare
from motionloom.datasets.shards.finish import join_parts
from motionloom.datasets.shards.options import Part

PROCESS = """
import os, signal, sys
from pathlib import Path
from motionloom.datasets.convert.bvh.convert import Bvh, BvhConfig
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.shards.options import Part

source, out, part, workers, dies_at = sys.argv[1:]
encode, left = Bvh.encode, [int(dies_at)]

def dies(self, *clip):
    left[0] -= 1
    if left[0] == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return encode(self, *clip)

if __name__ == "__main__":
    Bvh.encode = dies
    share = None if part == "all" else Part.parse(part)
    made = prepare(BvhConfig(source=source, licence="CC0-1.0"), out=Path(out))
    run_conversion(made, Path(out), workers=int(workers), clips_per_shard=3, progress=False, part=share)
"""


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """40 clips of four skeletons; one is broken, one has no certain joint map, one's name is no UTF-8."""
    root = tmp_path_factory.mktemp("mocap")
    for seed, left in zip(range(40), 10 * [b"left_", b"Left_", b"LEFT_", b"left-"], strict=True):
        write_clip(path := root / f"take{seed % 2}" / f"{seed}.bvh", seed, 36)
        path.write_bytes(path.read_bytes().replace(b"left_", left))
    whole = (root / "take0" / "0.bvh").read_bytes()
    (root / "armless.bvh").write_bytes(whole.replace(b"left_", b"gauche_"))
    (root / "take1" / "cut.bvh").write_bytes(whole[:-40])
    Path(os.fsdecode(bytes(root) + b"/\x83\xff.bvh")).write_bytes(whole + b"\n")
    return root


@pytest.mark.slow
def test_parts_that_run_at_once_and_die_give_the_bytes_of_one_process(source: Path, tmp_path: Path) -> None:
    rng = random.Random()
    count = rng.randint(2, 5)
    (tmp_path / "convert.py").write_text(PROCESS)

    def start(out: str, part: object, dies_at: int = 0) -> subprocess.Popen[bytes]:
        workers = 1 if dies_at else rng.randint(1, 2)
        words = (tmp_path / "convert.py", source, tmp_path / out, part, workers, dies_at)
        return subprocess.Popen([sys.executable, *map(str, words)])

    parts = [Part(number, count) for number in range(1, count + 1)]
    rng.shuffle(parts)
    # The first one dies while it converts (the look at the source reads clips without this function).
    running = [start("parts", part, 0 if at else rng.randint(1, 2)) for at, part in enumerate(parts)]
    running.append(start("whole", "all"))
    assert [process.wait() for process in running] == [-9, *[0] * count], f"{count} parts"
    with pytest.raises(UserError, match=f"part {parts[0]} is missing"):
        join_parts(tmp_path / "parts")
    assert not (tmp_path / "parts/manifest.json").exists() and not (tmp_path / "parts/index.npz").exists()
    assert start("parts", parts[0]).wait() == 0
    joined = join_parts(tmp_path / "parts")
    assert joined == Manifest.load_json(tmp_path / "whole/manifest.json")
    assert sum(shard.samples for shard in joined.shards) == 40 and len(joined.dropped) == 3
    assert digests(tmp_path / "parts") == digests(tmp_path / "whole"), f"{count} parts"


def test_one_part_reads_the_source_for_all(shared: Path, tmp_path: Path) -> None:
    """The others open their own clips; later conversions what has changed."""
    opened: list[Path] = []
    sys.addaudithook(
        lambda event, of: opened.append(Path(of[0])) if event == "open" and str(of[0])[:1] == "/" else None
    )
    source = Path(shutil.copytree(shared / "data/layouts/humanml3d", tmp_path / "source"))
    kind = converter_named("humanml3d")
    config = kind.config_class.parse({"source": source, "look": 0}, "test")

    def read() -> set[str]:
        return {path.stem for path in opened if path.parent.parent == source}

    for out, part in (*(("parts", Part(number, 2)) for number in (1, 2)), ("whole", None)):
        opened.clear()
        planned = prepare(config, kind=kind, out=tmp_path / out, write=True)
        manifest = run_conversion(planned, tmp_path / out, progress=False, clips_per_shard=2, part=part)
        indices = [tmp_path / out / shard.name.replace(".tar", ".index") for shard in manifest.shards]
        own = {
            Path(clip["source"]).stem for path in indices for clip in json.loads(path.read_text())["clips"]
        }
        assert own and (read() == own or part in (None, Part(1, 2))), f"{out} {part}"
    join_parts(tmp_path / "parts")
    assert digests(tmp_path / "parts") == digests(tmp_path / "whole")
    opened.clear()
    (source / "texts/900002.txt").touch()
    assert prepare(config, kind=kind, out=tmp_path / "whole", write=True).options and read() == {"900002"}


SILENT = {"audio_features": False, "sound_rate": 8000}
CASES: dict[str, dict[str, Any]] = {
    "bvh": {"licence": "CC0-1.0"}, "humanml3d": {}, "motionx": {}, "aistpp": {"sound": "none"}, "amass": {},
    "motionhub": SILENT, "finedance": SILENT, "bones_seed": {}, "motion272": {}, "snapmogen": {},
    "beat2": SILENT, "style100": {},
}  # fmt: skip
"""Settings of each converter."""


def source_of(kind: str, root: Path, shared: Path, mocap: Path) -> Path:
    """A folder of a converter's source, free to change."""
    if kind in ("humanml3d", "motionx", "aistpp"):
        return Path(shutil.copytree(shared / "data/layouts" / kind, root))
    if kind == "amass":
        for number in range(3):
            amass_clips.save(root / f"KIT/3/{number}_poses.npz", **amass_clips.walk(60.0, 2.0 + number))
    elif kind == "bvh":
        root.mkdir()
        for name in ("take0/0.bvh", "take1/1.bvh", "take1/3.bvh"):
            shutil.copy(mocap / name, root)
        own = (root / "3.bvh").read_text().replace("left_wrist", "left_hand")
        (root / "3.bvh").write_text(own)  # the only file of its skeleton
        with tarfile.open(shared / "data/real/cmu/amc.tar.xz", "r|*") as archive:
            for member in archive:
                if member.name in ("amc/01.asf", "amc/01_01.amc", "amc/02.asf", "amc/02_01.amc"):
                    archive.extract(member, root, filter="data")
    else:
        getattr(release_trees, kind)(root)
    if kind == "snapmogen":
        shutil.copy(root / "renamed_feats/m_ep2_00086.npy", root / "renamed_feats/other.npy")
        said = json.loads((root / "all_caption_clean.json").read_text())
        release_trees.put(root / "all_caption_clean.json", {**said, "other#0#90": {"manual": ["walks"]}})
        shutil.rmtree(root / "data_split_info1")
    return root


@pytest.mark.parametrize("tries", [3, pytest.param(12, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", CASES)
def test_one_damaged_or_misnamed_file_leaves_the_others(
    kind: str, tries: int, source: Path, shared: Path, tmp_path: Path
) -> None:
    """A damaged byte, end or name of any file leaves the others converted; a sentence says what is wrong with
    a list of clips.
    """
    converter, whole = converter_named(kind), source_of(kind, tmp_path / "whole", shared, source)
    seed = 7 if tries < 10 else random.randrange(2**32)
    rng, before = random.Random(seed), -1
    for number in range(tries + 1):
        case, folder = f"{kind}: damage {number} of seed {seed}", tmp_path / "folder"
        out = tmp_path / f"out{number}"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(whole, folder)
        files = sorted(path for path in folder.rglob("*") if path.is_file() and "official" not in str(path))
        harmed = rng.choice([path for path in files if is_clip(path)] if number % 2 else files)
        if number:
            damage(rng, harmed)
        given = {"source": folder, "most_rejected": 1, "look": number % 3, **CASES[kind]}
        try:
            planned = prepare(converter.config_class.parse(given, case), kind=converter, out=out)
            manifest = run_conversion(planned, out, progress=False)
        except UserError as error:
            assert number and not is_clip(harmed), f"{case}: {harmed}: {error}"
            assert "\n" not in str(error)
            continue
        clips = sum(shard.samples for shard in manifest.shards)
        lost = {drop.source: drop.reason for drop in manifest.dropped}
        if is_clip(harmed):
            assert clips >= before - 2, (
                f"{case}: {harmed}: {lost}"
            )  # its clips: also a mirrored one, or two cuts
        assert Manifest.load_json(out / "manifest.json") == manifest, case
        before = max(before, clips)


def is_clip(path: Path) -> bool:
    """Whether a file is of a single clip: its motion, words, labels or sound."""
    lists = ("train", "val", "test", "all_caption", "ignore_list", "seed_metadata")
    own = path.suffix[1:] in ("bvh", "amc", "asf", "npy", "npz", "pkl", "wav", "TextGrid", "txt", "json")
    return own and not any(word in path.name for word in lists) and "golden" not in str(path)


def damage(rng: random.Random, path: Path) -> None:
    """Change a byte, cut the end off, or give it another name, in place."""
    data = bytearray(path.read_bytes())
    kind = rng.randrange(3)
    if kind == 0 and data:
        data[rng.randrange(len(data))] = rng.randrange(256)
        path.write_bytes(data)
    elif kind == 1 and data:
        path.write_bytes(data[: rng.randrange(len(data))])
    else:
        name = bytes(rng.choice(b'A \n,"\\\x8f\xe9\xff') for _ in range(6))
        path.rename(os.fsdecode(bytes(path.parent) + b"/" + name + path.suffix.encode()))
