"""Measure a GPT's start at a million clips, and a training that reads them from S3.

    python benchmarks/growth_run.py WORK gpt                 # the first rank of a machine, and another
    python benchmarks/growth_run.py WORK s3 --steps 300      # two nodes, each with a cache of a tenth

Sets are those of `growth.py`. Captions are two a clip, none like another; their vectors, 32 wide, and TMA's
latents, 256 wide, are made. The bucket, moto's, holds hard links of a few shards, each with last bytes of its
own, so that no two are one file in a cache; what the nodes train is `vq` of width 16 under Lightning.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import logging
import os
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from growth import LAYOUT, SIZES, made

from motionloom.datasets.base.records import INDEX_FILE, MANIFEST_FILE, Caption
from motionloom.datasets.loading.plan import Share
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.shards.cache import CacheConfig
from motionloom.datasets.shards.options import Reading
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.text.cache import TextCache
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.models.tokenizer.single import VqConfig
from motionloom.pipeline.contract.stage import stage_kind
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.stages.networks.gpt import GptStage, GptStageConfig
from motionloom.pipeline.stages.networks.tokens import Tokens
from motionloom.pipeline.store import tokens

WIDTH, LATENT = 32, 256


def own_memory() -> float:
    """Megabytes that no other process shares."""
    rows = map(str.split, Path("/proc/self/smaps_rollup").read_text().splitlines())
    return next(int(row[1]) for row in rows if row[0] == "Anonymous:") / 1e3


class Worded(ShardDataset):
    """The clips of a set of hard links, with captions of their own."""

    def texts(self, i: int) -> list[Caption]:
        super().texts(i)  # costs what it does
        return [Caption(text=f"a person {verb} {i:07d} times") for verb in ("walks", "turns")]


def prepare(dataset: Worded, work: Path, streams: Any) -> None:
    """Write the text cache and the tokens of a set."""
    texts = [f"a person {verb} {i:07d} times" for i in range(len(dataset)) for verb in ("walks", "turns")]
    keys = np.frombuffer(b"".join(sorted(hashlib.sha256(t.encode()).digest() for t in texts)), np.uint8)
    cache = work / "text"
    cache.mkdir(parents=True)
    shapes = {"sentence": (np.float32, len(texts)), "tokens": (np.float16, 3 * len(texts))}
    for name, (kind, rows) in shapes.items():
        np.lib.format.open_memmap(cache / f"{name}.npy", "w+", kind, (rows, WIDTH))[:] = 0.1
    np.save(cache / "keys.npy", keys.reshape(-1, 32))
    np.save(cache / "offsets.npy", np.arange(len(texts) + 1) * 3)
    about = {"encoder": "made", "dim": WIDTH, "count": len(texts)}
    (cache / "cache.json").write_text(json.dumps(about))
    starts = np.concatenate([[0], np.cumsum(np.maximum(dataset.frames // 4, 1))]).astype(np.int64)
    codes = {s.name: torch.zeros(int(starts[-1]) * s.per_group, dtype=torch.int32) for s in streams}
    whole = np.ones(len(dataset), dtype=np.bool_)
    per_group = {s.name: s.per_group for s in streams}
    tokens.TokenStore(codes, starts, per_group, whole).save(work / "tokens-train.safetensors")


class FastTma(SimpleNamespace):
    """Latents without a network, whose time is the GPU's."""

    def embed_captions(self, texts: list[str], cache: TextCache) -> torch.Tensor:
        return torch.zeros(len(texts), LATENT)


def start(root: Path, work: Path) -> dict[str, float]:
    """CPU seconds to the first batch of a rank of eight, and its own memory beside the networks."""
    torch.manual_seed(0)
    tokenizer = VqConfig(width=8, depth=1, code_dim=8, num_codes=8, part="body").build(LAYOUT)
    net = InterleavedGPT(
        GptConfig(layers=1, dim=32, heads=2, ff=64), tokenizer.streams, tokenizer.pattern, LATENT
    )
    if not (work / "text" / "cache.json").exists():
        prepare(Worded.open(root, "train"), work, tokenizer.streams)
    inputs: Any = SimpleNamespace(
        text=SimpleNamespace(cache=TextCache.open(work / "text"), dim=WIDTH),
        tokenizer=SimpleNamespace(net=tokenizer), tokens=Tokens(work, tuple(tokenizer.streams)),
        tma=FastTma(), work=work / "work",
    )  # fmt: skip
    before = own_memory()
    began = time.process_time()
    dataset = ShardDataset.open(root, "train")
    dataset.__class__ = Worded
    inputs.data = SimpleNamespace(split=lambda _: dataset, held_out=lambda: dataset)
    config = GptStageConfig(prior="tma")
    batches = GptStage().batches(config, net, inputs, 0, print).train(256, Share(0, 8))
    batches[0]
    return {"CPU s": time.process_time() - began, "own MB": own_memory() - before}


PADDING = 512
"""Bytes behind the end of a linked shard that are its own."""


@contextlib.contextmanager
def bucket(root: Path) -> Iterator[tuple[dict[str, str], Counter[str]]]:
    """(environment, number of times that each object was read) of a bucket that holds a set, once a node."""
    import boto3
    from moto.core import DEFAULT_ACCOUNT_ID
    from moto.s3.models import FakeKey, s3_backends
    from moto.server import ThreadedMotoServer

    read: Counter[str] = Counter()

    class Linked(FakeKey):  # type: ignore[misc]
        """An object with the content of another, and last bytes of its own."""

        __module__ = FakeKey.__module__  # moto files its classes by it

        @property
        def value(self) -> bytes:
            read[self.name] += 1
            return bytes(FakeKey.value.fget(self)) + self.last  # type: ignore[attr-defined]

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    url = "http://127.0.0.1:{1}".format(*server.get_host_and_port())
    keys = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1"}
    os.environ.update({**keys, "AWS_ENDPOINT_URL": url})
    client = boto3.client("s3")
    client.create_bucket(Bucket="made")
    manifest = json.loads((root / MANIFEST_FILE).read_bytes())
    stored: dict[int, tuple[Any, Any]] = {}
    linked = []
    for number, shard in enumerate(manifest["shards"]):
        path = root / shard["name"]
        inode = path.stat().st_ino
        if inode not in stored:
            client.put_object(Bucket="made", Key=f"base/{inode}", Body=path.read_bytes())
            base = s3_backends[DEFAULT_ACCOUNT_ID]["aws"].buckets["made"].keys[f"base/{inode}"]
            stored[inode] = base, hashlib.sha256(path.read_bytes())
        base, begun = stored[inode]
        last = number.to_bytes(PADDING, "big")
        whole = begun.copy()
        whole.update(last)
        linked.append({**shard, "bytes": shard["bytes"] + PADDING, "sha256": whole.hexdigest()})
        for node in "01":
            key = object.__new__(Linked)
            key.__dict__.update(
                {**vars(base), "name": f"{node}/{shard['name']}", "last": last, "_etag": None}
            )
            key.contentsize = linked[-1]["bytes"]
            key.checksum_algorithm = key.checksum_value = None
            s3_backends[DEFAULT_ACCOUNT_ID]["aws"].buckets["made"].keys[key.name] = key
    for node in "01":
        body = json.dumps({**manifest, "shards": linked})
        client.put_object(Bucket="made", Key=f"{node}/{MANIFEST_FILE}", Body=body)
        client.upload_file(str(root / INDEX_FILE), "made", f"{node}/{INDEX_FILE}")
    try:
        yield {**keys, "AWS_ENDPOINT_URL": url}, read
    finally:
        server.stop()


def node(place: str, cache: str, gigabytes: float, steps: int, batch: int) -> None:
    """Train as one of two nodes; print how long it waited for each batch but the first, and all took."""
    import lightning as L

    from motionloom.pipeline.training.loaders import StageData

    reading = Reading(order="streamed", cache=CacheConfig(folder=cache, gigabytes=gigabytes))
    dataset = ShardDataset.open(place, "train", reading=reading)
    zero = np.zeros(LAYOUT.dim, dtype=np.float32)
    data = SimpleNamespace(layout=LAYOUT, split=lambda _: dataset, held_out=lambda: dataset)
    inputs: Any = SimpleNamespace(data=data, stats=FeatureStats(zero, zero + 1, LAYOUT), start=None)
    kind: Any = stage_kind("vq", "made")
    settings = {
        "net": {"width": 16, "depth": 1, "code_dim": 8, "num_codes": 16, "part": "body"},
        "window": 16,
        "train": {"steps": steps, "batch_size": batch},
    }
    config = kind.config.parse(settings, "made")
    net, _ = kind.build(config, inputs, 0)
    module = kind.module(config, net, inputs, 0)
    batches = kind.batches(config, net, inputs, 0, print)
    stage = StageData(
        type(batches)(batches.train, None), config.train, Hardware(accelerator="cpu", workers=1)
    )
    waits: list[float] = []

    @contextlib.contextmanager
    def waiting() -> Iterator[None]:
        began = time.monotonic()
        yield
        waits.append(time.monotonic() - began)

    stage.waiting = waiting
    began = time.monotonic()
    trainer = L.Trainer(
        accelerator="cpu", devices=1, num_nodes=2, strategy="ddp", max_steps=steps, logger=False,
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
        use_distributed_sampler=False, limit_val_batches=0,
    )  # fmt: skip
    trainer.fit(module, stage)
    late = [wait for wait in waits[1:] if wait > 0.5]
    print(
        json.dumps({"s": time.monotonic() - began, "first": waits[0], "late": late, "wait": sum(waits[1:])})
    )


def from_s3(root: Path, work: Path, steps: int, batch: int) -> None:
    """A training of two nodes: what each fetched of its share, how large its cache was, how it waited."""
    shards = json.loads((root / MANIFEST_FILE).read_bytes())["shards"]
    size = sum(shard["bytes"] + PADDING for shard in shards)
    most = size / 10
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with bucket(root) as (environment, read):
        print(f"{len(shards):,} shards, {size / 1e9:.1f} GB, {sum(s['samples'] for s in shards):,} clips")
        nodes = []
        for rank in "01":
            given = [f"s3://made/{rank}", str(work / f"cache{rank}"), str(most / 1e9), str(steps), str(batch)]
            found = {**os.environ, **environment, "NODE_RANK": rank, "MASTER_ADDR": "127.0.0.1"}
            command = [sys.executable, "-P", __file__, str(work), "node", "--given", *given]
            pipe = subprocess.PIPE
            nodes.append(
                subprocess.Popen(command, env={**found, "MASTER_PORT": str(port)}, stdout=pipe, text=True)
            )
        largest = [0, 0]
        while any(one.poll() is None for one in nodes):
            for rank in (0, 1):
                files = [*(work / f"cache{rank}").glob("*")]
                with contextlib.suppress(OSError):
                    largest[rank] = max(largest[rank], sum(file.stat().st_size for file in files))
            time.sleep(0.3)
        sizes = {shard["name"]: shard["bytes"] + PADDING for shard in shards}
        share = size * (steps * batch / sum(shard["samples"] for shard in shards)) / 2
        for rank, one in enumerate(nodes):
            own = {name[2:]: times for name, times in read.items() if name.startswith(f"{rank}/")}
            fetched = sum(sizes[name] for name in own)
            again = sum(times > 2 for times in own.values())  # by HEAD and by GET
            said = one.communicate()[0].strip().rpartition("\n")[2]
            print(
                f"node {rank}: {len(own)} shards, {fetched / share:.3f} of its share, {again} again, cache "
                f"at most {largest[rank] / most:.3f} of its limit; {said}"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("what", choices=("gpt", "s3", "node"))
    parser.add_argument("--size", type=int, default=SIZES[-1])
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--given", nargs=5)
    args = parser.parse_args()
    if args.what == "node":
        place, cache, gigabytes, steps, batch = args.given
        node(place, cache, float(gigabytes), int(steps), int(batch))
    elif args.what == "s3":
        from_s3(made(args.work, args.size), args.work, args.steps, args.batch)
    else:
        print(start(made(args.work, args.size), args.work / f"gpt{args.size}"))


if __name__ == "__main__":
    main()
