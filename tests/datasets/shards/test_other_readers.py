"""The shards as others read them: Megatron-Energon, Hugging Face `datasets` and plain `webdataset`."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from motionloom.datasets.schema import SPLITS, Caption, ClipMeta, UserError
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.synth.generate import SynthConfig, synthesize


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
    return folder


def tars(folder: Path, split: str) -> list[str]:
    return [str(path) for path in sorted(folder.rglob(f"*-{split}-*.tar"))]


def with_webdataset(folder: Path, split: str) -> Iterator[dict[str, Any]]:
    import webdataset

    yield from webdataset.WebDataset(tars(folder, split), shardshuffle=False).decode("torch")


def with_datasets(folder: Path, split: str, **how: Any) -> Iterator[dict[str, Any]]:
    datasets = pytest.importorskip("datasets")
    read = datasets.load_dataset(
        "webdataset", data_files={split: tars(folder, split)}, split=split, cache_dir=folder / "hf", **how
    )
    yield from read.with_format("numpy", columns=["motion.npy"], output_all_columns=True)


def with_typed_datasets(folder: Path, split: str) -> Iterator[dict[str, Any]]:
    """Clips of which some have captions of the face, or features of sound: what is not in all is named."""
    datasets = pytest.importorskip("datasets")
    text, number = datasets.Value("string"), datasets.Value("float32")
    caption = dict.fromkeys(("text", "source", "tokens"), text) | {"start": number, "end": number}
    first = ShardDataset.open(folder, split).meta(0).dump()
    meta = {
        name: datasets.Value({str: "string", bool: "bool"}.get(type(v), "float64"))
        for name, v in first.items()
    }
    arrays = {name: datasets.List(datasets.List(number)) for name in ("motion.npy", "audio.npy")}
    texts = {name: datasets.List(caption) for name in ("texts.json", "face_texts.json")}
    features = arrays | texts | {"meta.json": meta, "__key__": text, "__url__": text}
    yield from with_datasets(folder, split, features=datasets.Features(features))


def with_energon(folder: Path, split: str) -> Iterator[dict[str, Any]]:
    energon = pytest.importorskip("megatron.energon")
    command = [Path(sys.executable).with_name("energon"), "prepare", folder, "--non-interactive"]
    for name in SPLITS:
        command += ["--split-parts", f"{name}:.*-{name}-.*"]
    command += ["--no-progress", "--num-workers", "1", "--sample-type", "CrudeWebdataset"]
    done = subprocess.run([*command, "--force-overwrite"], capture_output=True, text=True)
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
    (with_webdataset, "synth0"), (with_datasets, "synth0"), (with_energon, "synth0"),
    (with_webdataset, "made"), (with_typed_datasets, "made"), (with_energon, "made"),
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


def test_shards_of_another_release_are_refused(made: ModuleType, tmp_path: Path) -> None:
    made.write(tmp_path)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    (tmp_path / "manifest.json").write_text(json.dumps({**manifest, "schema_version": 2}))
    with pytest.raises(UserError, match=r"schema version 2, not 3: .* again"):
        ShardDataset.open(tmp_path, "train")
    made.write(tmp_path)
    assert len(ShardDataset.open(tmp_path, "train")) == 36
