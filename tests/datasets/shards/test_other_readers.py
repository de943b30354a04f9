"""The shards as others read them: Megatron-Energon, Hugging Face `datasets` and plain `webdataset`."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from fsspec.implementations.local import LocalFileSystem

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import SPLITS, Caption, ClipMeta
from motionloom.datasets.check.dataset import check
from motionloom.datasets.convert.common.removed import remove
from motionloom.datasets.shards import store
from motionloom.datasets.shards.copy import copy_dataset
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.store import open_store
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.curation.add_command import add


@pytest.fixture(scope="module")
def sets(made: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two synthetic sets, one of more clips than a table's first batch, and a made one of mixed members.

    None has sound, which these readers decode by packages of their own (av, torchcodec).
    """
    folder = tmp_path_factory.mktemp("sets")
    for seed, clips in ((0, 130), (1, 12)):
        config = SynthConfig(clips=clips, seed=seed, layout="body133")
        synthesize(config, folder / f"synth{seed}", progress=False)
    made.write(folder / "made", count=30, convert=lambda i: replace(made.clip(i), wav=None))
    shutil.copytree(folder / "synth1", folder / "../bare").joinpath("README.md").unlink()
    return folder


def tars(folder: Path, split: str) -> list[str]:
    return [str(path) for path in sorted(folder.rglob(f"*-{split}-*.tar"))]


def with_webdataset(folder: Path, split: str) -> Iterator[dict[str, Any]]:
    import webdataset

    yield from webdataset.WebDataset(tars(folder, split), shardshuffle=False).decode("torch")


def with_datasets(folder: Path, split: str) -> Iterator[dict[str, Any]]:
    datasets = pytest.importorskip("datasets")
    read = datasets.load_dataset(
        "webdataset", data_files={split: tars(folder, split)}, split=split, cache_dir=folder / "hf"
    )
    arrays = [name for name in read.column_names if name == "motion.npy"]  # a column's tar has none
    yield from read.with_format("numpy", columns=arrays, output_all_columns=True)


def with_folder(folder: Path, split: str) -> Iterator[dict[str, Any]]:
    """What a hub shows: nothing is said but where the set is, and its card says the rest."""
    datasets = pytest.importorskip("datasets")
    split = {"val": "validation"}.get(split, split)
    read = datasets.load_dataset(str(folder), split=split, cache_dir=folder / "hf2")
    yield from read.with_format("numpy", columns=["motion.npy"], output_all_columns=True)


def with_energon(folder: Path, split: str) -> Iterator[dict[str, Any]]:
    energon = pytest.importorskip("megatron.energon")
    command = [Path(sys.executable).with_name("energon"), "prepare", folder, "--non-interactive"]
    for name in SPLITS:
        command += ["--split-parts", f"{name}:.*-{name}-.*"]
    command += ["--no-progress", "--num-workers", "1", "--sample-type", "CrudeWebdataset"]
    done = subprocess.run(
        [*command, "--force-overwrite", "--exclude", "^columns/"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout

    @energon.edataclass
    class Clip(energon.Sample):  # type: ignore[name-defined, misc]
        members: dict[str, Any]

    @energon.stateless
    def cook(sample: dict[str, Any]) -> Clip:
        return Clip(**energon.basic_sample_keys(sample), members=dict(sample))

    class Encoder(energon.DefaultTaskEncoder):  # type: ignore[name-defined, misc]
        cookers = [energon.Cooker(cook)]  # noqa: RUF012

        @energon.stateless
        def batch(self, samples: list[Clip]) -> list[Clip]:
            return samples

    read = energon.get_val_dataset(
        folder, split_part=split, batch_size=1, task_encoder=Encoder(),
        worker_config=energon.WorkerConfig(rank=0, world_size=1, num_workers=0),
    )  # fmt: skip
    for (clip,) in energon.get_loader(read):
        yield clip.members


READERS = [
    (with_webdataset, "synth0"), (with_datasets, "synth0"), (with_energon, "synth0"), (with_folder, "synth0"),
    (with_webdataset, "made"), (with_folder, "made"), (with_energon, "made"), (with_folder, "../bare"),
]  # fmt: skip


@pytest.mark.parametrize(("read", "name"), READERS)
def test_all_clips_of_another_reader_are_ours(read: Callable[..., Any], name: str, sets: Path) -> None:
    for split in ("train", "val"):
        ours = ShardDataset.open(sets / name, split)
        clips = {sample["meta.json"]["id"]: sample for sample in read(sets / name, split)}
        assert sorted(clips) == sorted(ours.ids)
        for i, clip in enumerate(ours.ids):
            theirs = clips[clip]
            np.testing.assert_array_equal(np.asarray(theirs["motion.npy"], np.float32), ours.motion(i))
            audio = ours.array(i, "audio.npy")
            assert (theirs.get("audio.npy") is None) == (audio is None)
            if audio is not None:
                np.testing.assert_array_equal(np.asarray(theirs["audio.npy"], np.float32), audio)
            assert ClipMeta.parse(theirs["meta.json"], clip) == ours.meta(i)
            for member, texts in (("texts.json", ours.texts(i)), ("face_texts.json", ours.face_texts(i))):
                assert [Caption.parse(text, clip) for text in theirs.get(member) or []] == texts


def test_keys_are_unique_over_sets_and_name_their_clip(sets: Path) -> None:
    seen: dict[str, str] = {}
    for split in SPLITS:
        for sample in with_webdataset(sets, split):
            key, clip = sample["__key__"], sample["meta.json"]["id"]
            assert key.startswith(clip.replace("ä", "_")) and key.replace("-", "").replace("_", "").isalnum()
            assert key not in seen
            seen[key] = clip
    assert len(seen) == 130 + 12 + 30
    assert next(with_energon(sets, "train")), "prepares the folder of all sets"


def test_no_field_is_null(sets: Path) -> None:
    for sample in with_webdataset(sets, "train"):
        for record in (sample["meta.json"], *sample["texts.json"]):
            assert None not in record.values() and not {list, dict} & {type(v) for v in record.values()}


def test_a_column_is_read_with_its_clips(sets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Zipped by `webdataset`, joined by `datasets` and Megatron-Energon: tars of the same keys and order."""
    data = Path(shutil.copytree(sets / "made", tmp_path / "made"))
    ours = ShardDataset.open(data, "val")
    lines = [json.dumps({"id": name, "captions": [f"more of {name}"]}) for name in ours.ids[1:]]
    (tmp_path / "more.jsonl").write_text("\n".join(lines))
    add(str(data), tmp_path / "more.jsonl")
    side = data / "columns" / "more"
    wanted = {name: [f"more of {name}"] * (i > 0) for i, name in enumerate(ours.ids)}
    pairs = zip(with_webdataset(sets / "made", "val"), with_webdataset(side, "val"), strict=True)
    read = [{**clip, **column} for clip, column in pairs if clip["__key__"] == column["__key__"]]
    clips, columns = ([*with_folder(data, "val")], [*with_datasets(side, "val")])
    assert [one["__key__"] for one in clips] == [one["__key__"] for one in columns]
    read += [{**clip, "more.json": column["more.json"]} for clip, column in zip(clips, columns, strict=True)]
    energon = pytest.importorskip("megatron.energon")
    for folder in (side, data):
        assert next(with_energon(folder, "val"))
    joined = {"__module__": "shard_samples", "__function__": "joined"}
    parts = [{"path": str(folder), "split_part": "val"} for folder in (data, side)]
    recipe = {"__module__": "megatron.energon", "__class__": "MetadatasetV2"}
    config = tmp_path / "join.yaml"
    config.write_text(json.dumps({**recipe, "splits": {"val": {"join": parts, "joiner": joined}}}))
    helpers = str(Path(__file__).parents[2] / "helpers")
    command = [Path(sys.executable).with_name("energon"), "prepare", config]
    subprocess.run(command, check=True, env={**os.environ, "PYTHONPATH": helpers})
    worker = energon.WorkerConfig(rank=0, world_size=1, num_workers=0)

    class Encoder(energon.DefaultTaskEncoder):  # type: ignore[name-defined, misc]
        @energon.stateless
        def batch(self, samples: list[Any]) -> list[Any]:
            return samples

    both = energon.get_val_dataset(
        config, split_part="val", batch_size=1, task_encoder=Encoder(), worker_config=worker
    )
    # A device that another test has registered cannot pin memory.
    monkeypatch.setattr("torch.accelerator.is_available", lambda: False)
    read += [clip for (clip,) in energon.get_loader(both)]
    assert len(read) == 3 * len(ours)
    for clip in read:
        assert [one["text"] for one in clip["more.json"] or []] == wanted[clip["meta.json"]["id"]]


def test_shards_of_another_release_are_refused(made: ModuleType, tmp_path: Path) -> None:
    made.write(tmp_path)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    (tmp_path / "manifest.json").write_text(json.dumps({**manifest, "schema_version": 2}))
    with pytest.raises(UserError, match=r"schema version 2, not 3: .* again"):
        ShardDataset.open(tmp_path, "train")
    made.write(tmp_path)
    assert len(ShardDataset.open(tmp_path, "train")) == 36


# A data set carried to a bucket, a folder or the hub's stand-in: resumed, compared, whole or not at all.


@pytest.fixture
def data(root: Path, tmp_path: Path) -> Path:
    """The data set, to be changed."""
    return Path(shutil.copytree(root, tmp_path / "data"))


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def aws(loopback: ModuleType, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A server with the empty bucket `shards`, of which one request in five fails."""
    empty = tmp_path / "empty"
    empty.mkdir()
    monkeypatch.setattr(store, "FIRST_PAUSE", 0.001)
    with loopback.bucket(empty, every=5) as (environment, network):
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        yield network


def test_to_a_bucket_and_back(aws: Any, data: Path, tmp_path: Path) -> None:
    count = len(files(data))
    assert copy_dataset(str(data), "s3://shards/a/b") == (count, 0)
    assert aws.failures
    assert copy_dataset(str(data), "s3://shards/a/b") == (0, count)
    assert ShardDataset.open("s3://shards/a/b", "val").ids == ShardDataset.open(data, "val").ids
    back = tmp_path / "deep" / "back"
    assert copy_dataset("s3://shards/a/b", str(back)) == (count, 0)
    assert files(back) == files(data) and check(back) == []
    with pytest.raises(UserError, match="no such bucket"):
        copy_dataset(str(data), "s3://nowhere/x")
    with pytest.raises(UserError, match="no such bucket"):
        ShardDataset.open("s3://nowhere/x", "train")
    with pytest.raises(UserError, match="only read"):
        copy_dataset(str(data), "http://127.0.0.1:1/x")


def test_a_damaged_byte_at_either_end_is_found(aws: Any, data: Path) -> None:
    aws.every = 0
    copy_dataset(str(data), "s3://shards/x")
    count = len(files(data))
    assert aws.received < 100 and aws.requests < 3 * count + 10, "nothing comes back of what was sent"
    before = aws.requests
    copy_dataset(str(data), "s3://shards/x")
    assert aws.received < 100 and aws.requests == before + count + 1, "a question for each, and no byte"
    shard = data / "made-val-000000.tar"
    whole = shard.read_bytes()
    damaged = whole[:5000] + bytes([whole[5000] ^ 1]) + whole[5001:]
    there = open_store("s3://shards/x")
    there.system().pipe_file(there.where(shard.name), damaged)
    assert copy_dataset(str(data), "s3://shards/x").sent == 1, "the damaged one alone"
    assert there.system().cat_file(there.where(shard.name)) == whole
    shard.write_bytes(damaged)
    with pytest.raises(UserError, match=rf"{shard.name}: the sha256"):
        copy_dataset(str(data), "s3://shards/y")
    assert not open_store("s3://shards/y").system().exists("s3://shards/y/manifest.json")


KILLED = """
import contextlib, os, signal, sys
from motionloom.datasets.shards import copy
carry, count = copy._send_file, 0
def killed(here, there, name, *rest):
    global count
    count += 1
    if count == 17:  # 16 are sent at once: one is there whole
        if isinstance(there, copy.LocalStore):
            (there.root / f".{name}.tmp").write_bytes(b"half")
        else:
            with contextlib.suppress(Exception):  # the network fails now and then
                there.system().pipe_file(there.where(name), b"half")
        os.kill(os.getpid(), signal.SIGKILL)
    return carry(here, there, name, *rest)
copy._send_file = killed
copy.copy_dataset(sys.argv[1], sys.argv[2])
"""


def test_killed_in_the_middle_and_given_again(aws: Any, data: Path, tmp_path: Path) -> None:
    for target in ("s3://shards/k", str(tmp_path / "k")):
        process = subprocess.run([sys.executable, "-P", "-c", KILLED, str(data), target], env=os.environ)
        assert process.returncode == -signal.SIGKILL
        with pytest.raises(UserError, match=r"no manifest\.json"):
            ShardDataset.open(target, "train")
        copied = copy_dataset(str(data), target)
        assert copied.sent + copied.kept == len(files(data)) and copied.sent and copied.kept
        assert ShardDataset.open(target, "train").motion(0).tobytes()
    for half in (tmp_path / "k").glob(".*.tmp"):
        half.unlink()
    assert files(tmp_path / "k") == files(data)


def test_a_folder_that_cannot_be_written_is_no_server(data: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(NotADirectoryError):  # of which the command line makes one sentence
        copy_dataset(str(data), str(tmp_path / "file/x"))


def test_a_later_state_takes_the_place_of_an_older_one(
    aws: Any, made: ModuleType, data: Path, tmp_path: Path
) -> None:
    aws.every = 0
    gone = ShardDataset.open(data, "test").ids[0]
    for there in ("s3://shards/later", str(tmp_path / "there")):
        copy_dataset(str(data), there)
    copies = copy_dataset(str(data), there).kept
    remove(data, ids=[gone])
    for there in ("s3://shards/later", str(tmp_path / "there")):
        assert copy_dataset(str(data), there).kept > copies // 2, "other shards are as they were"
        assert gone not in ShardDataset.open(there, "test").ids
    assert files(tmp_path / "there") == files(data) and check(data) == []
    assert not any(f'"{gone}"'.encode() in content for content in files(tmp_path / "there").values())
    less = tmp_path / "less"
    made.write(less, count=20)
    copy_dataset(str(less), there)
    assert files(tmp_path / "there") == files(less)
    made.write(tmp_path / "other", count=8, name="other")
    with pytest.raises(UserError, match="holds data set 'made', not 'other'"):
        copy_dataset(str(tmp_path / "other"), there)
    (data / "index.npz").unlink()
    with pytest.raises(UserError, match=r"index\.npz"):
        copy_dataset(str(data), str(tmp_path / "new"))
    assert not (tmp_path / "new" / "manifest.json").exists()


class Hub(LocalFileSystem):
    """The interface of the hub's file system on a folder: a big file's sha256 is in its record."""

    protocol = "hf"
    root = ""

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(Path(cls.root, path.removeprefix("hf://").lstrip("/"))) if "hf://" in path else path

    def info(self, path: str, **options: Any) -> dict[str, Any]:
        import hashlib

        found = super().info(path, **options)
        if path.endswith(".tar"):
            found["lfs"] = {"sha256": hashlib.sha256(Path(found["name"]).read_bytes()).hexdigest()}
        return found


def test_a_data_set_of_the_hub(
    made: ModuleType, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Hub, "root", str(tmp_path / "hub"))
    monkeypatch.setattr(store, "connect", lambda *_: Hub(auto_mkdir=True, skip_instance_cache=True))
    remove(data, ids=ShardDataset.open(data, "test").ids[:1])
    place = "hf://datasets/owner/name"
    told = {name: content for name, content in files(data).items() if name != "removed.json"}
    count = len(told)
    assert copy_dataset(str(data), place) == (count, 0) and copy_dataset(str(data), place) == (0, count)
    assert files(tmp_path / "hub" / "datasets" / "owner" / "name") == told
    assert b"\nlicense: other\nlicense_name: CC0\n" in told["README.md"]
    (data / "README.md").write_text("our own words")
    made.write(data)
    assert files(data)["README.md"] == b"our own words"
    assert ShardDataset.open(place, "val").ids == ShardDataset.open(data, "val").ids
