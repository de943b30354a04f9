"""`check` beyond checksums: ranges, captions, sound, duplicates and leaks; and damaged tars."""

from __future__ import annotations

import gzip
import io
import re
import tarfile
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from shard_samples import LAYOUT, write_made

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Caption, Split
from motionloom.datasets.check import dataset
from motionloom.datasets.check.dataset import CheckReport, check_once, examine
from motionloom.datasets.check.findings import LISTED, Findings
from motionloom.datasets.check.leaks import find_leaks
from motionloom.datasets.motion.canonical import canonicalize, mirror, resample
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.shards import sample as sample_module
from motionloom.datasets.shards import tar as shards
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.tar import scan_tar
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.cli.main import app
from motionloom.pipeline.runs.api import run_recipe


def walk(seed: int, frames: int = 40) -> np.ndarray:
    """Joints [T, 22, 3] of a swaying figure that nothing else resembles."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 4, frames)[:, None, None]
    waves = rng.uniform(0.02, 0.08, (3, 1, 22, 3)) * np.sin(
        rng.uniform(0.5, 3, (3, 1, 22, 3)) * t + rng.uniform(0, 6, (3, 1, 22, 3))
    )
    joints = LAYOUT.skeleton.rest_joints + waves.sum(axis=0)
    joints[:, :, 2] += np.linspace(0, 1.5, frames)[:, None]
    return canonicalize(joints)


def features(seed: int, frames: int = 40) -> np.ndarray:
    return encode(walk(seed, frames), LAYOUT)


@dataclass(frozen=True)
class Made:
    """What becomes of one clip of a test set."""

    id: str
    split: Split = "train"
    motion: np.ndarray = field(default_factory=lambda: features(0))
    mirror_of: str | None = None
    texts: tuple[Caption, ...] = (Caption(text="a person sways"),)
    licence: str = "CC0"
    more: dict[str, Any] = field(default_factory=dict)


def convert(made: Made) -> Sample:
    meta = LAYOUT.clip_meta(
        made.id, source="made", split=made.split, frames=len(made.motion), licence=made.licence,
        mirror_of=made.mirror_of,
    )  # fmt: skip
    return Sample(meta, made.motion, texts=list(made.texts), **made.more)


def report_on(root: Path, *clips: Made) -> CheckReport:
    items = [(clip.split, clip) for clip in clips]
    return examine(write_made(root, items, convert, describe=lambda clip: clip.id, strict=True))


def test_the_same_motion_twice(tmp_path: Path) -> None:
    report = report_on(
        tmp_path,
        Made("a"),
        Made("b"),
        Made("c", "test"),
        Made("other", motion=features(1)),
        Made("x", "val", features(2)),
    )
    assert report.warning_kinds == {"same motion": 1}
    (error,) = report.errors
    assert all(part in str(error) for part in ("'c'", "'train'", "'test'"))


def test_many_recordings_in_two_splits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A shard's headers are read once, and many findings are one sentence on the first."""
    motions = [features(seed) * np.float32(1 + 1e-6 * copy) for copy in range(2) for seed in range(7)]
    halves: list[Split] = ["train"] * 7 + ["test"] * 7
    pairs = enumerate(zip(halves, motions, strict=True))
    made = [Made(f"c{at:02d}", split, motion) for at, (split, motion) in pairs]
    report_on(tmp_path, *made)
    read, whole = Counter[str](), shards._entries
    monkeypatch.setattr(shards, "_entries", lambda *of: (read.update([of[0].name]), whole(*of))[1])
    assert app(["data", "check", str(tmp_path)], standalone_mode=False) == 1
    assert set(read.values()) == {1} and len(read) == 2
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "same recording" in line]
    assert "…" not in line and "6 more" in line and "'train'" in line


def test_processes_find_what_one_finds_and_a_sound_set_is_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = [Made(f"c{at}", ("train", "test")[at % 2], features(at)) for at in range(9)]
    sound = write_made(tmp_path / "a", [(one.split, one) for one in made], convert, clips_per_shard=1)
    odd = [*made, Made("c9", "test", features(0)), Made("c10", texts=(), licence="none")]
    items = [(one.split, one) for one in odd]
    broken = write_made(tmp_path / "b", items, convert, describe=lambda clip: clip.id, clips_per_shard=1)
    (broken / "made-train-000000.tar").write_bytes(b"no tar")
    one, several = (examine(broken, workers=workers) for workers in (1, 2))
    assert one == several and len(one.errors) >= 2 and len(one.warnings) >= 2
    assert not (broken / dataset.CHECKED_FILE).exists()
    read: list[str] = []
    look = dataset.examine_shard
    monkeypatch.setattr(
        dataset, "examine_shard", lambda shard, **of: (read.append(shard.name), look(shard, **of))[1]
    )
    problems, states = check_once(sound)
    assert not problems and len(read) == 9 and states.keys() >= set(read)
    assert check_once(sound) == ([], states) and len(read) == 9
    for name in (read[4], "index.npz", "manifest.json"):
        before = len(read)
        (sound / name).touch()
        if name == "manifest.json":
            (sound / name).write_text((sound / name).read_text() + " ")
        assert check_once(sound)[0] == [] and len(read) == before + 9, f"{name} was written anew"


def test_a_mirror_image_that_does_not_say_so(tmp_path: Path) -> None:
    image = encode(canonicalize(mirror(walk(0), LAYOUT.skeleton)), LAYOUT)
    jittered = (features(1).astype(np.float64) * (1 + 1e-6)).astype(np.float32)
    jittered[:, LAYOUT.slice("root_height")] = features(1)[:, LAYOUT.slice("root_height")]
    report = report_on(
        tmp_path,
        Made("a"),
        Made("image", "test", image),
        Made("b", motion=features(1)),
        Made("b2", "val", jittered),
    )
    named = [re.findall(r"'(image|b2)'.* '(a|b)'", str(error)) for error in report.errors]
    assert sorted(named) == [[("b2", "b")], [("image", "a")]]
    same_split = report_on(tmp_path / "same", Made("a"), Made("image", "train", image))
    assert (same_split.errors, same_split.warnings) == ([], [])


@pytest.mark.parametrize("how", ["1 frame", "3 frames", "15 frames", "2 % slower", "noise"])
def test_a_copy_that_was_changed(tmp_path: Path, how: str) -> None:
    """Four figures at 60 fps, copied before they are resampled."""
    clips = []
    for seed in range(4):
        joints = walk(seed, 480)
        cut = int(how.split()[0]) if "frame" in how else 0
        copy = joints[cut:]
        if how == "noise":
            copy = copy + np.random.default_rng(9).normal(0, 5e-4, copy.shape)
        both = resample(joints, 60.0, 20.0), resample(copy, 60.0 / 1.02 if "%" in how else 60.0, 20.0)
        one, other = (encode(canonicalize(figure), LAYOUT) for figure in both)
        clips += [Made(f"a{seed}", motion=one), Made(f"b{seed}", "test", other)]
    errors = report_on(tmp_path, *clips).errors
    named = {tuple(re.findall(r"'([ab]\d)'", str(error))[-2:]) for error in errors}
    assert {tuple(sorted(pair)) for pair in named} == {(f"a{seed}", f"b{seed}") for seed in range(4)}


def test_mirror_images_stay_in_the_split_of_their_family(tmp_path: Path) -> None:
    report = report_on(
        tmp_path,
        Made("a"),
        Made("Ma", "test", features(1), mirror_of="a"),
        Made("Mb", "train", features(2), mirror_of="b"),
        Made("Mb2", "test", features(3), mirror_of="b"),
        Made("Mc", "train", features(4), mirror_of="gone"),
    )
    quoted = sorted(re.findall(r"'(\w+)'", problem.message) for problem in report.errors)
    assert quoted == [["a", "train", "test"], ["b", "Mb", "train", "test"]]


@pytest.mark.parametrize(
    ("name", "value", "word"),
    [("root_height", 90.0, "root_height[0] is 90"), ("velocities", 25.0, "is 500 m/s")],
)
def test_absurd_values_are_errors(tmp_path: Path, name: str, value: float, word: str) -> None:
    motion = features(0)
    motion[3, LAYOUT.slice(name).start] = value
    report = report_on(tmp_path, Made("a", motion=motion), Made("b", motion=features(1)))
    assert word in str(report.errors[0])
    assert "'a-" in report.errors[0].where
    motion = features(0)
    motion[3, LAYOUT.slice("velocities").start + 5] = -5.0
    glitch = report_on(tmp_path / "glitch", Made("a", motion=motion))
    assert glitch.errors == [] and "velocities[5] is -100 m/s" in str(glitch.warnings[0])


def test_numbers_that_are_none_are_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The writer refuses them too, so here it looks away."""
    motion = features(1)
    motion[7, 3] = np.nan
    monkeypatch.setattr(sample_module, "require_finite", lambda *_: None)
    report = report_on(tmp_path, Made("a"), Made("b", motion=motion))
    assert "in row 7" in " ".join(map(str, report.errors))


@pytest.mark.parametrize(
    ("captions", "error", "warning"),
    [
        ((), "", "no captions"),
        ((Caption(text="a"), Caption(text=" \t")), "caption 2 is empty", ""),
        ((Caption(text="a", start=1.0, end=0.5),), "ends at 0.5 s, not after its start", ""),
        ((Caption(text="a", start=-1.0),), "has the times -1.0", ""),
        ((Caption(text="a", start=2.0, end=3.0),), "starts at 2 s, the clip ends at 2.00 s", ""),
        ((Caption(text="a", start=0.0, end=2.6),), "", "ends at 2.6 s, the clip at 2.00 s"),
        ((Caption(text="a", start=0.5, end=2.4),), "", ""),
    ],
)
def test_captions(tmp_path: Path, captions: tuple[Caption, ...], error: str, warning: str) -> None:
    report = report_on(tmp_path, Made("a", texts=captions), Made("b", motion=features(1)))
    assert len(report.errors) == (2 if error else 0)  # a bad clip also breaks the shard's frame count
    assert len(report.warnings) == bool(warning)
    assert error in " ".join(map(str, report.errors)) and warning in " ".join(map(str, report.warnings))


def test_sound_and_its_features(tmp_path: Path) -> None:
    sound = {"wav": (np.zeros(800, np.float32), 8000), "audio": np.zeros((4, 438), np.float32)}
    assert report_on(tmp_path / "good", Made("a", more=sound)).errors == []
    other = {"audio": np.zeros((4, 35), np.float32)}
    report = report_on(tmp_path / "mixed", Made("a", more=sound), Made("b", "val", features(1), more=other))
    assert "35 columns, that of" in str(report.errors[0])
    silent = {"wav": (np.zeros(0, np.float32), 8000)}
    report = report_on(tmp_path / "silent", Made("a", more=silent), Made("b", motion=features(1)))
    assert "audio.flac" in str(report.errors[0])


def test_licences_and_splits_are_told(tmp_path: Path) -> None:
    report = report_on(
        tmp_path, Made("a", "test", licence="CC-BY-4.0"), Made("b", "test", features(1), licence=" ")
    )
    assert report.warning_kinds == {"licence": 2, "no licence": 1, "no training split": 1}
    assert "'CC-BY-4.0'" in " ".join(map(str, report.warnings))


def test_findings_are_bounded_and_counted() -> None:
    findings = Findings()
    for k in range(LISTED + 500):
        findings.error("NaN", f"clip {k}", "NaN")
        findings.warn("odd", f"clip {k}", "odd")
    for listed in (findings.all_errors("root"), findings.all_warnings("root")):
        assert len(listed) == LISTED + 1 and str(listed[-1]).startswith("root: 500 more: ")


# ---- damaged shards


def npy(values: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values)
    return buffer.getvalue()


def tar(path: Path, *members: tuple[str, bytes]) -> Path:
    with tarfile.open(path, "w") as archive:
        for name, content in members:
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return path


def sample(key: str) -> tuple[tuple[str, bytes], ...]:
    return (f"{key}.motion.npy", npy(np.zeros((4, 133), np.float32))), (f"{key}.meta.json", b"{}")


def test_cut_joined_and_packed_shards(tmp_path: Path) -> None:
    path = tar(tmp_path / "x.tar", *sample("a"), *sample("b"))
    whole = path.read_bytes()
    for cut in range(512, len(whole) - 10240, 700):
        path.write_bytes(whole[:cut])
        with suppress(UserError):  # wherever it is cut, a shard is refused or whole clips are left
            assert all(len(clip.members) == 2 for clip in scan_tar(path))
    header = whole.index(b"b.motion.npy")
    for content, word in (
        (b"", "0 bytes"),
        (whole + whole, "two archives"),
        (whole[:header] + b"damage" * 20 + whole[header + 120 :], "in the header at byte"),
        (gzip.compress(whole), "not a readable tar"),
        (whole[: header + 700], "the last whole key is 'a'"),
    ):
        path.write_bytes(content)
        with pytest.raises(UserError, match=word):
            scan_tar(path)


class Clips:
    def __init__(self, split: Split, clips: dict[str, np.ndarray]) -> None:
        self.split, self.ids, self._motions = split, list(clips), list(clips.values())
        self.frames = np.array([len(motion) for motion in self._motions])

    def motion(self, i: int) -> np.ndarray:
        return self._motions[i]


def test_a_recording_in_two_splits_is_found_whatever_it_is_called() -> None:
    rng = np.random.default_rng(0)
    walk, run, jump, sit = (rng.normal(size=(9, 4)).astype(np.float32) for _ in range(4))
    again = run + np.float32(1e-4)
    other = {
        "train": Clips("train", {"x": walk, "run": again, "sit": jump}),
        "test": Clips("test", {"j": jump}),
    }
    one = {
        "train": Clips("train", {"sit": sit, "j": jump}),
        "test": Clips("test", {"walk": walk, "run": run}),
    }
    leaks = find_leaks({"one": one, "other": other})  # type: ignore[dict-item]
    assert [re.findall(r"'(\w+)' of \w+ \((\w+)\)", leak) for leak in leaks] == [
        [("j", "train"), ("j", "test")],
        [("walk", "test"), ("x", "train")],
        [("run", "test"), ("run", "train")],
    ]
    assert find_leaks({"one": one, "same": one}) == []  # type: ignore[dict-item]


RECIPE = """
name: leaky
hardware: {{accelerator: cpu, convert_workers: 1}}
stages:
  one: {{kind: shards, path: {folder}/one}}
  two: {{kind: shards, path: {folder}/two}}
  data: {{kind: mix, allow_leaks: {allowed}}}
"""


def test_a_leaking_mix_is_refused_unless_it_is_allowed(tmp_path: Path) -> None:
    for name, val in (("one", 0.0), ("two", 0.9)):
        given = SynthConfig(layout="body133", clips=6, seed=3, val_fraction=val, test_fraction=0.0)
        synthesize(given, tmp_path / name)
    recipe = tmp_path / "recipe.yaml"
    for allowed in (False, True):
        recipe.write_text(RECIPE.format(folder=tmp_path, allowed=str(allowed).lower()))
        if allowed:
            run_recipe(recipe, tmp_path / "run", console=Console(quiet=True))
            continue
        with pytest.raises(UserError, match=r"allow_leaks"):
            run_recipe(recipe, tmp_path / "run", console=Console(quiet=True))
