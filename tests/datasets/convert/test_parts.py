"""A conversion in parts, by processes of their own; and sources of which any file is damaged or misnamed."""

from __future__ import annotations

import hashlib
import os
import random
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from bvh_clips import write_clip

from motionloom.datasets.convert.common.conversion import SCAN_FILE, run_conversion
from motionloom.datasets.convert.registry import converter_named, prepare
from motionloom.datasets.schema import Manifest, UserError
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


def bytes_of(root: Path) -> dict[str, str]:
    """Of all but what a scan remembers."""
    found = [path for path in sorted(root.rglob("*")) if path.is_file() and path.name != SCAN_FILE]
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in found}


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
    assert bytes_of(tmp_path / "parts") == bytes_of(tmp_path / "whole"), f"{count} parts"


CASES = {
    "bvh": ({"licence": "CC0-1.0"}, 12),
    "humanml3d": ({}, 6),
    "motionx": ({}, 6),
    "aistpp": ({"sound": "none"}, 4),
}
"""Settings, and damages that are tried, of each converter."""


@pytest.mark.parametrize("kind", CASES)
def test_one_damaged_or_misnamed_file_leaves_the_others(
    kind: str, source: Path, shared: Path, tmp_path: Path
) -> None:
    settings, tries = CASES[kind]
    root, converter = shared / "data/layouts" / kind, converter_named(kind)
    if kind == "bvh":
        (root := tmp_path / "bvh").mkdir()
        for name in ("take0/0.bvh", "take1/1.bvh", "take1/3.bvh"):
            shutil.copy(source / name, root)
        own = (root / "3.bvh").read_text().replace("left_wrist", "left_hand")
        (root / "3.bvh").write_text(own)  # the only file of its skeleton
    before, seed = -1, random.randrange(2**32)
    rng = random.Random(seed)
    for number in range(tries):
        case = f"{kind}: damage {number} of seed {seed}"
        folder, out = tmp_path / f"source{number}", tmp_path / f"out{number}"
        shutil.copytree(root, folder)
        last = sorted(path for path in folder.rglob("*") if is_motion(path))[-1]
        if number == 1:
            last.write_bytes(last.read_bytes()[:-40])
        elif number:
            damage(rng, rng.choice(sorted(path for path in folder.rglob("*") if is_motion(path))))
        config = converter.config_class.parse({"source": folder, "most_rejected": 1, **settings}, case)
        planned = prepare(config, kind=converter, out=out)
        manifest = run_conversion(planned, out, progress=False)
        clips = sum(shard.samples for shard in manifest.shards)
        lost = {drop.source: drop.reason for drop in manifest.dropped}
        assert clips >= before - 2, f"{case}: {lost}"  # a clip, and its mirrored twin
        assert Manifest.load_json(out / "manifest.json") == manifest, case
        before = max(before, clips)


def is_motion(path: Path) -> bool:
    return path.suffix in (".bvh", ".npy", ".pkl") and "official" not in str(path)


def damage(rng: random.Random, path: Path) -> None:
    """Change a byte, cut the end off, or give it another name, in place."""
    data = bytearray(path.read_bytes())
    kind = rng.randrange(3)
    if kind == 0:
        data[rng.randrange(len(data))] = rng.randrange(256)
        path.write_bytes(data)
    elif kind == 1:
        path.write_bytes(data[: rng.randrange(len(data))])
    else:
        name = bytes(rng.choice(b'A \n,"\\\x8f\xe9\xff') for _ in range(6))
        path.rename(os.fsdecode(bytes(path.parent) + b"/" + name + path.suffix.encode()))
