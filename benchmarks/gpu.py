"""The paper's sizes on a GPU: speed, share of its peak, memory against the estimate, sampling.

    python benchmarks/gpu.py WORK
    python benchmarks/gpu.py WORK --size tiny --device cpu --steps 20

About ten minutes on one GPU. It runs one recipe in WORK: synthetic whole-body clips of full length, then
H2VQ, TMA and the Hierarchical-GPT at the sizes of `humantomato-paper`, each some hundred steps in several
arithmetics, with the text prior and the alignment loss that training has. Told, and recorded by `--record`:

- samples a second and the time of a step: medians of the training's own log (`flight/`), its first third left
  out;
- the share of the device's peak (MFU): matrix operations of forward and backward pass, counted on a real
  batch (three times those of the forward pass; the optimizer and all that is elementwise count nothing), over
  the time of a step and the device's dense peak (`--peak-tflops` for devices not in the table);
- the share of time in which kernels ran, from a profile of a few steps;
- what the training waited for; its peak of memory, and what `--dry-run` said it would be;
- whole-body motions of 196 frames a minute, for several batches.

Where WORK has finished stages it goes on behind them, so a second call only prints.
"""

from __future__ import annotations

import gzip
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
import yaml
from bench import Column, Record, arguments, command_line, report
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils.flop_counter import FlopCounterMode

from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import CompletedStage, StageCache
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.launch.hardware import choose_device
from motionloom.pipeline.runs.dry_run import estimate
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.store.training_log import read_flight

PEAKS = {
    "H100 PCIe": (756, 51),
    "H100": (989, 67),
    "H200": (989, 67),
    "A100": (312, 19.5),
    "L40S": (362, 91.6),
    "L4": (121, 30.3),
    "RTX 4090": (165, 82.6),
    "RTX 3090": (71, 35.6),
}
"""Dense TFLOP/s by the makers' data sheets: half precision with float32 sums, and float32 without TF32."""

PRECISIONS = {"fp32": "32-true", "bf16": "bf16-mixed", "fp16": "16-mixed"}
TRAINED = {"tokenizer": "h2vq", "tma": "tma", "gpt": "gpt"}
FRAMES = 196


def recipe(size: str, steps: int, device: str, profile: int) -> dict[str, Any]:
    """Synthetic clips and every variant of the three trainings, each a stage."""
    stages: dict[str, Any] = {
        "data": {
            "kind": "synth", "clips": 512 if size == "paper" else 48, "fps": 30 if size == "paper" else 20,
            "min_seconds": 6.5, "max_seconds": 7.0,
        },
        "generate": None, "evaluate": None, "report": None, "face_tokenizer": None, "face_tokens": None,
        "face_gpt": None,
    }  # fmt: skip
    train = {"steps": steps, "checkpoint_every": steps, "validate_every": 0}
    if size == "tiny":
        train["batch_size"] = 8
    base = load_recipe(f"humantomato-{size}")
    for name, kind in TRAINED.items():
        settings = base.stage(name).config.dump()
        if name == "gpt":  # L_align is part of every step that is measured
            settings["loss"]["align_from"] = 0
        stages[name] = {"train": train | {"precision": "bf16-mixed", "compile": False}}
        stages[name] |= {"loss": settings["loss"]} if name == "gpt" else {}
        others = [(short, PRECISIONS[short], False) for short in ("fp32", "fp16")]
        for short, precision, compiled in [*others, ("bf16-compiled", "bf16-mixed", True)]:
            own = settings["train"] | train | {"precision": precision, "compile": compiled}
            stages[f"{name}-{short}"] = settings | {"kind": kind, "train": own}
    if device == "cpu":  # half precision on a CPU has no scaler
        stages = {name: stage for name, stage in stages.items() if "fp16" not in name}
    hardware: dict[str, Any] = {"accelerator": device if device != "cuda" else "gpu", "profile": profile}
    if device == "cpu":
        hardware["stall_seconds"] = 0  # a busy CPU may compile for longer than a step may take
    return {"name": "gpu", "extends": f"humantomato-{size}", "hardware": hardware, "stages": stages}


def flops(stage: CompletedStage) -> int:
    """FLOPs of a step: forward and backward pass over the first batch that it trained on."""
    stage_cache, kind, config = StageCache(), stage.kind, stage.config
    dry: Any = kind
    given = dry.inputs.of(stage_cache.given(stage.inputs))
    facts = dry.facts(config, given)
    net = dry.network(facts, given)
    batch = dry.batches(config, net, given, 0, lambda _: None).train(config.train.local_batch(1), 0, 1)[0]
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        fake = {k: mode.from_tensor(v) if isinstance(v, torch.Tensor) else v for k, v in batch.items()}
        module = dry.dry_module(config, dry.network(facts, given), given)
        module.train()
        with FlopCounterMode(display=False) as counter:
            module.losses(fake)
    return 3 * counter.get_total_flops()


def kernel_share(folder: Path) -> float | None:
    """Share of the profiled time in which at least one kernel ran; None without a GPU's profile."""
    path = folder / "flight" / "profile_rank_0.json.gz"
    if not path.is_file():
        return None
    events = json.loads(gzip.decompress(path.read_bytes()))["traceEvents"]
    spans = sorted((e["ts"], e["ts"] + e["dur"]) for e in events if e.get("cat") in ("kernel", "gpu_memcpy"))
    if not spans:
        return None
    busy, end = 0.0, spans[0][0]
    for first, last in spans:
        busy += max(0.0, last - max(first, end))
        end = max(end, last)
    return busy / (end - spans[0][0])


def peak(device: torch.device, precision: str, given: float | None) -> float | None:
    """TFLOP/s of the device in an arithmetic."""
    if given is not None:
        return given
    if device.type != "cuda":
        return None
    name = torch.cuda.get_device_name(device)
    found = next((pair for known, pair in PEAKS.items() if known in name), None)
    return None if found is None else found[1 if precision == "32-true" else 0]


def trainings(
    run: Path, stages: Mapping[str, CompletedStage], device: torch.device, tflops: float | None
) -> Iterator[Record]:
    """Rows of the table of trainings."""
    cards = estimate(load_recipe(run / "recipe.yaml", strict=False))
    for name, stage in stages.items():
        if name.split("-")[0] not in TRAINED:
            continue
        rows = read_flight(stage.folder)[0]
        rows = rows[len(rows) // 3 :]
        middle = {
            key: statistics.median(row[key] for row in rows) for key in ("step_seconds", "samples_per_second")
        }
        waited = {key: statistics.median(row["waited"][key] for row in rows) for key in rows[0]["waited"]}
        config = stage.config.train
        top, work = peak(device, config.precision, tflops), flops(stage)
        used = "" if top is None else f"{work / middle['step_seconds'] / top / 1e12:.1%}"
        share = kernel_share(stage.folder)
        most = max((row.get("cuda_peak_mib", 0.0) for row in rows), default=0.0) / 1024
        said = cards[name].memory_bytes / 2**30
        cells = {
            "arithmetic": config.precision + (", compiled" if config.compile else ""),
            "batch": str(config.batch_size),
            "samples/s": f"{middle['samples_per_second']:,.0f}",
            "ms a step": f"{1000 * middle['step_seconds']:.1f}",
            "TFLOP a step": f"{work / 1e12:.3g}",
            "of the peak": used,
            "kernels run": "" if share is None else f"{share:.0%}",
            "waited for": ", ".join(f"{key} {value:.1%}" for key, value in waited.items()),
            "peak GiB": f"{most:.3g}" if most else "",
            "dry run said": f"{said:.3g}" + (f" ({said / most - 1:+.0%})" if most else ""),
        }
        yield {"title": name.split("-")[0], "cells": cells}


def sampling(run: Path, device: torch.device, batches: list[int]) -> Iterator[Record]:
    """Rows of the table of sampling."""
    bundle = Bundle.open(run, device)
    seconds = min(FRAMES / bundle.layout.fps, bundle.max_seconds)
    for batch in batches:
        captions = ["a person walks forward"] * batch
        for attempt in range(2):  # the first one chooses kernels
            begin = time.perf_counter()
            made = bundle.generate(
                captions, seconds=seconds, seed=attempt, sampling=SamplingConfig(), batch=batch
            )
            took = time.perf_counter() - begin
        cells = {
            "frames": str(len(made[0].joints)),
            "seconds": f"{took:.2f}",
            "motions a minute": f"{60 * batch / took:,.0f}",
        }
        yield {"title": f"{batch} at once", "cells": cells}


def run_all(stages: Mapping[str, Any], where: list[str]) -> list[str]:
    """Run the stages; of the compiled ones, which depend most on torch's version, those that failed."""
    trained = {name: stage["train"] for name, stage in stages.items() if stage and "train" in stage}
    compiled = [name for name, train in trained.items() if train["compile"]]
    run = [sys.executable, "-P", "-m", "motionloom.pipeline.cli.main", "run", *where, "--until"]
    subprocess.run([*run, ",".join(name for name in trained if name not in compiled)], check=True)
    return [name for name in compiled if subprocess.run([*run, name]).returncode]


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--size", choices=("paper", "small", "tiny"), default="paper")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--steps", type=int, default=200, help="of each training")
    parser.add_argument("--profile", type=int, default=10, help="steps of each training that are profiled")
    parser.add_argument("--peak-tflops", type=float, help="of the device, where the table does not know it")
    parser.add_argument(
        "--batches", type=int, nargs="+", default=[1, 32, 256], help="motions sampled at once"
    )
    args = arguments(parser)
    device = choose_device(args.device)
    args.work.mkdir(parents=True, exist_ok=True)
    path, run = args.work / "gpu.yaml", args.work / "run"
    content = recipe(args.size, args.steps, args.device, args.profile)
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    failed = run_all(content["stages"], [str(path), "-o", str(run)])
    stages = finished_stages(run)
    named = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    where = f"{named}, torch {torch.__version__}, `humantomato-{args.size}`, {args.steps} steps each"
    tables = {
        "trainings": list(trainings(run, stages, device, args.peak_tflops)),
        "sampling": list(sampling(run, device, args.batches)),
    }
    for name, rows in tables.items():
        columns = [Column(title, title) for title in rows[0]["cells"]]
        report(f"{name}: {where}", columns, rows, args.record and f"{args.record}_{name}")
    if failed:
        raise SystemExit(f"ended with an error: {', '.join(failed)}")


if __name__ == "__main__":
    main()
