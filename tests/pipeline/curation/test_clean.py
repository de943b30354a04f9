"""`data clean`: planted faults are found and nothing else, and what is decided is what readers skip."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from shard_samples import LAYOUT, write_made

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Caption, Decisions, Split
from motionloom.datasets.check.dataset import examine
from motionloom.datasets.motion.canonical import canonicalize, mirror
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.judge import judge
from motionloom.datasets.shards.options import Reading
from motionloom.datasets.shards.reader import ShardDataset, load_manifest
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.synth.generate import SynthConfig, make_clip
from motionloom.pipeline.curation.suspects import decide, find_suspects, open_splits, undo
from motionloom.pipeline.runs.api import run_recipe

CONFIG = SynthConfig(clips=30, seed=3, layout="body133")
Joints = np.ndarray


@pytest.fixture(scope="module")
def people() -> list[Joints]:
    """Joints of people who do basic things on a floor."""
    return [make_clip(k, CONFIG).joints for k in range(CONFIG.clips)]


def lifted(by: float) -> Callable[[Joints], Joints]:
    return lambda joints: joints + np.array([0, by, 0])


def dipped(joints: Joints) -> Joints:
    half = len(joints) // 2
    joints[half : half + 5, :, 1] -= 0.15
    return canonicalize(joints)


def moved(frames: slice) -> Callable[[Joints], Joints]:
    def go(joints: Joints) -> Joints:
        joints[frames, :, 0] += 0.3
        return joints

    return go


def swapped(frames: slice) -> Callable[[Joints], Joints]:
    def go(joints: Joints) -> Joints:
        joints[frames] = joints[frames][:, LAYOUT.skeleton.mirror]
        return joints

    return go


def trembling(joints: Joints) -> Joints:
    return joints + np.random.default_rng(0).normal(0, 0.008, joints.shape)


def stretched(joints: Joints) -> Joints:
    joints[7, 20] += [0.0, 0.2, 0.0]
    return joints


def flipped(limb: str, frames: int) -> Callable[[Joints], Joints]:
    """Turn the joints below a limb's joint to its other side for some frames."""

    def go(joints: Joints) -> Joints:
        skeleton = LAYOUT.skeleton
        below = [skeleton.index(limb)]
        for joint, parent in enumerate(skeleton.parents):
            if parent in below and joint not in below:
                below.append(joint)
        part = slice(12, 12 + frames)
        joints[part, below] = 2 * joints[part, below[:1]] - joints[part, below]
        return joints

    return go


def frozen(joints: Joints) -> Joints:
    joints[-11:] = joints[-11]
    return joints


PLANTED: list[tuple[str, Callable[[Joints], Joints]]] = [
    ("floats", lifted(0.15)),
    ("sinks", lifted(-0.15)),
    ("sinks", dipped),
    ("jumps", moved(slice(12, None))),
    ("jumps", moved(slice(12, 13))),
    ("jitters", trembling),
    ("swapped sides", swapped(slice(None))),
    ("swapped sides", swapped(slice(10, None))),
    ("no person", lambda joints: joints * 2.54),
    ("no person", lambda joints: canonicalize(joints * [1, -1, -1])),
    ("no person", stretched),
    ("stands along the ground", lambda joints: joints[..., [0, 2, 1]] * [1, 1, -1]),
    ("frozen", frozen),
    *(
        ("flips", flipped(limb, n))
        for limb in ("left_hip", "right_knee", "left_shoulder", "right_elbow")
        for n in (1, 2, 6, 10)
    ),
]


def test_nothing_is_wrong_with_people(people: list[Joints]) -> None:
    for joints in people:
        assert [*judge(joints, LAYOUT.fps)] == []
        lies = joints @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # lower than the feet have stood
        both = [joints + np.array([0, 0.1, 0]), lies[-1:].repeat(9, 0) - [0, lies[-1, :, 1].min(), 0]]
        assert "floats" not in {fault.kind for fault in judge(np.concatenate(both), LAYOUT.fps)}


@pytest.mark.parametrize(("kind", "spoil"), PLANTED)
def test_planted_faults_are_found(kind: str, spoil: Callable[[Joints], Joints], people: list[Joints]) -> None:
    found = 0
    for joints in people:
        faults = [*judge(spoil(joints.copy()), LAYOUT.fps)]
        assert all(fault.weight > 1 and 0 <= fault.frame < len(joints) for fault in faults)
        found += kind in {fault.kind for fault in faults}
    assert found >= 0.9 * len(people)  # feet that never rest say nothing


# --- a set, and decisions about it ------------------------------------------------------------------------


@dataclass(frozen=True)
class Made:
    id: str
    joints: Joints
    split: Split = "train"
    mirror_of: str | None = None


def convert(made: Made) -> Sample:
    motion = encode(canonicalize(made.joints), LAYOUT)
    meta = LAYOUT.clip_meta(
        made.id, source="s", split=made.split, frames=len(motion), licence="CC0", mirror_of=made.mirror_of
    )
    return Sample(meta, motion, texts=[Caption(text="a person moves")])


@pytest.fixture
def root(people: list[Joints], tmp_path: Path) -> Path:
    return write(tmp_path / "data", people)


def write(root: Path, people: list[Joints]) -> Path:
    clips = [Made(f"c{k}", joints, "test" if k < 3 else "train") for k, joints in enumerate(people[:12])]
    image = [mirror(joints, LAYOUT.skeleton) for joints in people[:12]]
    clips += [
        Made("copy", people[1]),
        Made("image", image[4]),
        Made("said", image[5], mirror_of="c5"),
        Made("jump", moved(slice(9, None))(people[20].copy())),
    ]
    items = [(clip.split, clip) for clip in clips]
    return write_made(root, items, convert, describe=lambda clip: clip.id, strict=True, clips_per_shard=5)


def test_suspects_of_a_set(root: Path) -> None:
    splits = open_splits(root)
    found = {s.id: s for s in find_suspects(splits).values()}
    later = "image" if "image" in found else "c4"  # of two of one split, the one that is read later
    kinds = {"copy": "duplicate", later: "mirrored twin", "jump": "jumps"}
    assert {clip: suspect.faults[0].kind for clip, suspect in found.items()} == kinds
    assert found["copy"].twin is not None and found["copy"].twin.split == "test"
    assert "copy" not in {s.id for s in find_suspects(splits, kept=("copy",)).values()}


def test_what_is_left_out_is_skipped_and_nothing_is_lost(root: Path, people: list[Joints]) -> None:
    before = (root / "manifest.json").read_bytes()
    assert any(kind.endswith("two splits") for kind in examine(root).error_kinds)
    train = ShardDataset.open(root, "train")
    decide(root, Decisions(left_out={"copy": "twice", "c7": "bad"}, kept=("image",)), "given.json")
    left = [k for k, clip in enumerate(train.ids) if clip not in ("copy", "c7")]
    for reading in (Reading(), Reading(order="streamed", shards_per_group=2)):
        clips = ShardDataset.open(root, "train", reading=reading)
        for dataset in (clips, pickle.loads(pickle.dumps(clips))):
            assert dataset.ids == [train.ids[k] for k in left] and len(dataset) == len(left)
            assert dataset.frames.tolist() == train.frames[left].tolist()
            for new, old in enumerate(left):
                np.testing.assert_array_equal(dataset.motion(new), train.motion(old))
                assert dataset.meta(new) == train.meta(old)
        (source,) = clips.sources()
        assert source.count == len(left) and (source.shards is None or len(source.shards) == len(left))
    assert ShardDataset.open(root, "train", every=True).ids == train.ids
    assert examine(root).errors == [] and ShardDataset.open(root, "test").ids
    write(root, people)  # converted again
    assert load_manifest(root).excluded == {"copy": "twice", "c7": "bad"}
    decide(root, Decisions(kept=("c7",)), "given.json")
    assert load_manifest(root).excluded == {"copy": "twice"}
    assert Decisions.of(root).kept == ("c7", "image")
    undo(root)
    assert (root / "manifest.json").read_bytes() == before and Decisions.of(root) == Decisions()


REFUSED = [
    (Decisions(left_out={"nobody": ""}), "given.json: no clip 'nobody'"),
    (Decisions(left_out={"c0": "", "c1": "", "c2": ""}), "every clip of split 'test'"),
]


@pytest.mark.parametrize(("given", "said"), REFUSED)
def test_decisions_that_do_not_fit(root: Path, given: Decisions, said: str) -> None:
    with pytest.raises(UserError, match=said):
        decide(root, given, "given.json")
    assert load_manifest(root).excluded == {}


def test_stages_that_have_read_other_clips_run_again(root: Path, tmp_path: Path) -> None:
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(
        f"name: clean\nhardware: {{accelerator: cpu, convert_workers: 1}}\nstages:\n"
        f"  data: {{kind: shards, path: {root}, verify: false}}\n  stats: {{kind: stats}}\n"
    )

    def statistics() -> bytes:
        run_recipe(recipe, tmp_path / "run", console=Console(quiet=True))
        return (tmp_path / "run/stages/stats/stats.safetensors").read_bytes()

    every = statistics()
    decide(root, Decisions(left_out={"c7": "bad"}), "given.json")
    assert statistics() != every
