"""`data clean`: planted faults are found and nothing else, and what is decided is what readers skip."""

from __future__ import annotations

import pickle
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from motionloom.datasets.check.claims import acts_of, caption_faults, claim_of, doubt, verdicts
from motionloom.datasets.check.dataset import examine
from motionloom.datasets.check.decisions import decide, undo
from motionloom.datasets.check.faults import motion_faults
from motionloom.datasets.check.suspects import find_suspects, open_splits
from motionloom.datasets.motion.canonical import canonicalize, mirror
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import Caption, Decisions, Split, UserError
from motionloom.datasets.shards.options import DatasetFacts, Reading, WriteOptions
from motionloom.datasets.shards.reader import ShardDataset, load_manifest
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.writer import write_dataset
from motionloom.datasets.synth.generate import SynthConfig, make_clip
from motionloom.datasets.synth.measure import described
from motionloom.pipeline.runs.api import run_recipe

LAYOUT = MotionLayout.named("body133")
CONFIG = SynthConfig(clips=30, seed=3, layout="body133")
Joints = np.ndarray


@pytest.fixture(scope="module")
def people() -> list[tuple[Joints, list[str]]]:
    """Joints and captions of people who do basic things on a floor."""
    return [(clip.joints, clip.texts) for clip in (make_clip(k, CONFIG) for k in range(CONFIG.clips))]


def test_what_joints_do_not_show_of_a_caption_is_named() -> None:
    done: dict[str, Joints] = {}
    for k in range(80):
        clip = make_clip(k, SynthConfig(clips=80, seed=3, actions="all"))
        done.setdefault(str(clip.truth["action"]), clip.joints)
    said = {name: f"a person {name}s" for name in ("walk", "turn", "run", "jump", "squat", "kick", "clap")}
    said |= {
        "hop": "hop",
        "punch": "throw a punch",
        "bow": "she bows",
        "crawl": "crawling",
        "lie": "he lies down",
    }
    said |= {"sit": "somebody sits on a chair"}
    for name, text in said.items():
        if name in done:
            assert doubt(text, done[name], 20.0) is None
        noun = {"lie": "lying down", "sit": "sitting"}.get(name, name)
        assert doubt(text, done["wave"], 20.0) == f"the motion shows no {noun}"
    for text in ("a person waves", "walk and then kick", "she jogs in place", "one plays chess"):
        assert doubt(text, done["wave"], 20.0) is None
    twice = np.concatenate([done["squat"], canonicalize(done["squat"])])
    count = described(twice, 20.0, "squat")["count"]
    assert doubt("one squats once", twice, 20.0) == f"the count is {count}, not 1"


@pytest.mark.parametrize(
    ("said", "asked", "seen"),
    [
        ("a person waves", [("wave",)], "the motion shows no wave"),  # a walk
        ("off you go", [("run",), ("walk",)], None),
        ("wave, then walk", [("wave", "walk"), ("wave", "run")], "no wave and then walk nor wave and"),
        ("go quickly", [("walk",)], "the speed is another, not quickly"),
        ("walk on", [("walk",)], None),
        ("go back to the wall slowly", [("walk",)], None),
    ],
)
def test_what_is_asked_for_is_to_be_seen(said: str, asked: list[tuple[str, ...]], seen: str | None) -> None:
    """Where it is known what the captions that are like a new one ask for."""
    config = SynthConfig(clips=200, seed=3, actions="all")
    walks = (make_clip(k, config) for k in range(config.clips))
    slow = "slowly" if "slowly" in said else None
    walk = next(c for c in walks if c.truth["action"] == "walk" and c.truth.get("speed") == slow)
    found = doubt(said, walk.joints, config.motion_layout.fps, asked)
    assert found is None if seen is None else found is not None and seen in found


def test_hands_that_are_said_are_both() -> None:
    config = SynthConfig(clips=2000, seed=3, actions="all")
    for side in ("left", "both"):
        clips = (make_clip(k, config) for k in range(config.clips))
        up = next(c for c in clips if c.truth["action"] == "raise" and c.truth["side"] == side).joints
        found = doubt("hands up", up, config.motion_layout.fps, [("raise",)])
        assert found == (None if side == "both" else f"the side is {side}, not both")


def test_acts_of_a_truth() -> None:
    config = SynthConfig(clips=80, seed=3, actions="all")
    truths = [make_clip(k, config).truth for k in range(config.clips)]
    turns = next(truth for truth in truths if truth["action"] == "then")
    assert acts_of(turns) == tuple(part["action"] for part in turns["parts"]) and len(acts_of(turns)) == 2
    assert acts_of({"action": "wave", "side": "left"}) == ("wave",)
    assert acts_of(None) == acts_of({"song": 3}) == ()


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
]


def test_nothing_is_wrong_with_people(people: list[tuple[Joints, list[str]]]) -> None:
    for joints, texts in people:
        assert [*motion_faults(joints, LAYOUT.fps)] == []
        assert [*caption_faults([Caption(text=text) for text in texts], joints, LAYOUT.fps)] == []


@pytest.mark.parametrize(("kind", "spoil"), PLANTED)
def test_planted_faults_are_found(
    kind: str, spoil: Callable[[Joints], Joints], people: list[tuple[Joints, list[str]]]
) -> None:
    found = 0
    for joints, _ in people:
        faults = [*motion_faults(spoil(joints.copy()), LAYOUT.fps)]
        assert all(fault.weight > 1 and 0 <= fault.frame < len(joints) for fault in faults)
        found += kind in {fault.kind for fault in faults}
    assert found >= 0.9 * len(people)  # feet that never rest say nothing


CLAIMS = [
    ("a person waves with the left hand", {"action": "wave", "side": "left"}),
    ("someone is walking and turning right.", {"action": "turn", "direction": "right"}),
    ("a person jumps up three times", {"action": "jump", "count": 3}),
    ("he kicks twice with the right leg", {"action": "kick", "side": "right", "count": 2}),
    ("a person walks backwards", {"action": "walk", "direction": "backward"}),
    ("a person waves", None),
    ("a person walks in a circle to the left", None),
    ("a person waves with the left hand, then kicks", None),
    ("a person does not turn left", None),
]


@pytest.mark.parametrize(("text", "claim"), CLAIMS)
def test_what_captions_claim(text: str, claim: dict[str, object] | None) -> None:
    assert claim_of(text) == claim


WRONG = {
    "left": "right",
    "right": "left",
    "once": "three times",
    "twice": "four times",
    "three times": "once",
}


def test_captions_that_say_another_thing(people: list[tuple[Joints, list[str]]]) -> None:
    judged = 0
    for joints, texts in people:
        for text in texts:
            said = re.sub(r"\b(left|right|once|twice|three times)\b", lambda found: WRONG[found[0]], text)
            if said != text and claim_of(said) is not None:
                [fault] = caption_faults([Caption(text=said)], joints, LAYOUT.fps)
                assert fault.kind == "caption disagrees" and said in fault.text
                judged += 1
    assert judged > 20


def test_what_a_caption_claims_is_seen_or_not() -> None:
    """Of whole bodies, hands too: all that true captions claim holds; of the mirror image no side does."""
    config = SynthConfig(clips=24, seed=5, layout="wholebody363")
    seen: Counter[str] = Counter()
    for clip in (make_clip(k, config) for k in range(config.clips)):
        for text in clip.texts:
            for one in verdicts(text, clip.joints, 30.0):
                assert one.holds is not False, (text, one)
                seen[one.what] += one.holds is True
            wrong = [one for one in verdicts(text, mirror(clip.joints, config.motion_layout.skeleton), 30.0)
                     if one.what in ("side", "direction") and one.said in ("left", "right")]  # fmt: skip
            assert all(one.holds is False and one.seen == WRONG[one.said] for one in wrong)
    assert min(seen[what] for what in ("action", "side", "count", "left_hand", "right_hand")) >= 3, seen


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
def root(people: list[tuple[Joints, list[str]]], tmp_path: Path) -> Path:
    return write(tmp_path / "data", people)


def write(root: Path, people: list[tuple[Joints, list[str]]]) -> Path:
    bodies = [joints for joints, _ in people]
    clips = [Made(f"c{k}", joints, "test" if k < 3 else "train") for k, joints in enumerate(bodies[:12])]
    image = [mirror(joints, LAYOUT.skeleton) for joints in bodies[:12]]
    clips += [
        Made("copy", bodies[1]),
        Made("image", image[4]),
        Made("said", image[5], mirror_of="c5"),
        Made("jump", moved(slice(9, None))(bodies[20].copy())),
    ]
    facts = DatasetFacts("made", LAYOUT, licence="CC0", converter="test", converter_version=1, options={})
    how = WriteOptions(progress=False, strict=True, clips_per_shard=5)
    write_dataset(root, [(c.split, c) for c in clips], convert, facts, how, describe=lambda clip: clip.id)
    return root


def test_suspects_of_a_set(root: Path) -> None:
    splits = open_splits(root)
    found = {s.id: s for s in find_suspects(splits).values()}
    later = "image" if "image" in found else "c4"  # of two of one split, the one that is read later
    kinds = {"copy": "duplicate", later: "mirrored twin", "jump": "jumps"}
    assert {clip: suspect.faults[0].kind for clip, suspect in found.items()} == kinds
    assert found["copy"].twin is not None and found["copy"].twin.split == "test"
    assert "copy" not in {s.id for s in find_suspects(splits, kept=("copy",)).values()}


def test_what_is_left_out_is_skipped_and_nothing_is_lost(
    root: Path, people: list[tuple[Joints, list[str]]]
) -> None:
    before = (root / "manifest.json").read_bytes()
    assert "same motion in two splits" in examine(root).error_kinds
    train = ShardDataset.open(root, "train")
    decide(root, Decisions(left_out={"copy": "twice", "c7": "bad"}, kept=("image",)), "given.json")
    left = [k for k, clip in enumerate(train.ids) if clip not in ("copy", "c7")]
    for reading in (Reading(), Reading(mode="streamed", order="streamed", shards_per_group=2)):
        clips = ShardDataset.open(root, "train", reading=reading)
        for dataset in (clips, pickle.loads(pickle.dumps(clips))):
            assert dataset.ids == [train.ids[k] for k in left] and len(dataset) == len(left)
            assert dataset.frames.tolist() == train.frames[left].tolist()
            dataset.prefetch(range(len(left)), ["motion.npy"])
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
