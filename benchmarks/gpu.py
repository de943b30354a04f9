"""One GPU in ten minutes: speed, share of the peak, memory, sampling, equal bytes, all stages of two recipes.

    python benchmarks/gpu.py WORK
    python benchmarks/gpu.py WORK --size tiny --device cpu --minutes 3

All in one process, without network but for a text encoder that is not here. Each row is written to
WORK/rows.jsonl as it is measured, so a killed run keeps its rows and the same command goes on behind them. A
row is begun only if the last one of its table would fit into what is left of `--minutes`; what did not fit is
named at the end. `--only "stages" "compiled gpt"` takes rows whose table and title begin so. In this order:

- `steps`: a training step without its loader, on a batch as large as training may see: wall time between
  synchronised points, TFLOP/s and share of the data sheet's peak, peak of memory and what `--dry-run` says;
  "free": without `hardware.deterministic`, which is on by default;
- `trainings`: stages as a run trains them (compiled), by their own telemetry, the first third left out;
- `tokens`: 51 tokens drawn with the GPT of the size, neither text nor joints, the second of two calls;
- `sampling`: whole-body motions of 196 frames, the second of two calls;
- `bytes`: each training once more: are the weights the same;
- `stages`: every stage of `baselines-tiny` and `baselines-tiny-ude`, 20 steps each;
- `compiled`: the steps again, compiled and replayed as CUDA graphs as by default; the GPT also with
  `train.residual: bf16`.
"""

from __future__ import annotations

import copy
import statistics
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import lightning as L
import torch
from bench import Column, arguments, command_line, report
from rich.console import Console
from rows import Cells, Rows
from torch import Tensor
from torch.utils._pytree import tree_map
from torch.utils.data import DataLoader

from motionloom.datasets.base.files import sha256_of
from motionloom.models.gpt.sampling import generate as draw_tokens
from motionloom.models.training.stage_module import Batch, StageModule
from motionloom.pipeline.contract.lookup import previews
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import Stage
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.generation import generate
from motionloom.pipeline.inference.request import Request
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.plan import Selection
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
from motionloom.pipeline.store.training_log import read_flight
from motionloom.pipeline.store.yaml import dump_yaml
from motionloom.pipeline.training.checkpointing import BackgroundWriter
from motionloom.pipeline.training.config import TrainConfig
from motionloom.pipeline.training.execution import LAUNCHES, deterministic, make_trainer, prepare_module
from motionloom.pipeline.training.utilization import pass_flops, peak_flops

PRECISIONS = {"fp32": "32-true", "bf16": "bf16-mixed"}
STEPPED = {"humantomato": ("tokenizer", "tma", "gpt", "mdm"), "ude": ("utt", "dmd")}
TRAINED = ("tokenizer", "tma", "gpt")
FRAMES = 196
SHORT = {"repeats": 2, "clips": 32, "size": 32, "decodings": 1, "truth_clips": 8, "movement_steps": 5}
"""Settings that make evaluations short."""


class Step(NamedTuple):
    """A stage's module and batch for single steps."""

    stage: Stage
    module: StageModule
    batch: Batch
    flops: int
    estimated: int
    """Bytes, as a dry run says."""


class Clock(L.Callback):
    """Times the steps behind four that choose kernels or compile, for about two seconds."""

    first = mean = 0.0
    """Seconds of the first step, and of one of those that count."""

    def __init__(self, synchronize: Callable[[], object]) -> None:
        self.synchronize = synchronize
        self.begin = 0.0
        self.last = 0

    def on_train_start(self, *_: Any) -> None:
        self.begin = self.now()

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        step = trainer.global_step
        if step not in (1, 4, self.last):
            return
        seconds = self.now() - self.begin
        self.begin = self.now()
        if step == 1:
            self.first = seconds
        elif step == 4:
            self.last = 4 + max(3, min(100, int(2 / (seconds / 3))))
        else:
            self.mean = seconds / (step - 4)
            trainer.should_stop = True

    def now(self) -> float:
        self.synchronize()
        return time.perf_counter()


class Benchmark:
    """Measurements at one size on one device."""

    def __init__(self, args: Namespace) -> None:
        accelerator: Any = "cpu" if args.device == "cpu" else "gpu"
        self.args = args
        self.device = Hardware(accelerator=accelerator).device()
        self.console = Console(file=(args.work / "log.txt").open("a", encoding="utf-8"), width=120)
        self.run = args.work / "run"
        self.hardware = [f"hardware.accelerator={accelerator}", "hardware.devices=1"]
        if args.device == "cpu":
            self.hardware += ["hardware.threads=1", "hardware.stall_seconds=0"]

    def recipe(self, family: str) -> Path:
        """A recipe of the size on synthetic clips of full length."""
        paper = self.args.size == "paper"
        data: dict[str, Any] = {"kind": "synth", "clips": 512 if paper else 48, "fps": 30 if paper else 20}
        data |= {"min_seconds": 6.5, "max_seconds": 7.0}
        stages: dict[str, Any] = {"data": data}
        base = f"baselines-{self.args.size}"
        if family == "ude":
            base = f"ude-{self.args.size}"
            data["dances"] = {"songs": 4}
            if paper:  # the hub's CLIP may be out of reach
                encoder = load_recipe("humantomato-tiny").stage("text").config.dump()["encoder"]
                stages |= {"captioned": None, "dances": None, "text": {"encoder": encoder}}
        else:
            train = {"steps": self.args.steps, "checkpoint_every": self.args.steps, "validate_every": 0}
            train |= {"precision": "bf16-mixed"} | ({} if paper else {"batch_size": 8})
            stages |= {name: {"train": train} for name in TRAINED}
            stages["gpt"]["loss"] = {"align_from": 0}  # a part of every step that is measured
        path = Path(self.args.work / f"{family}.yaml")
        path.write_text(dump_yaml({"name": family, "extends": base, "stages": stages}))
        return path

    @cached_property
    def recipes(self) -> dict[str, Recipe]:
        return {family: load_recipe(self.recipe(family), self.hardware) for family in STEPPED}

    def built(self, family: str, name: str) -> Step:
        """A stage's network before training, on inputs that are not trained either."""
        recipe = self.recipes[family]
        stage = recipe.stage(name)
        kind = stage.kind
        config = stage.config
        given = previews(stage, {one.name: one for one in recipe.stages})
        inputs = kind.inputs.of(given)
        torch.manual_seed(0)
        net = kind.network(kind.facts(config, inputs), inputs)
        module = kind.dry_module(config, net, inputs)
        batch = with_values(kind.example(config, net, inputs, config.train.local_batch(1)).batch, net)
        card = kind.estimate(config, given, recipe.hardware)
        return Step(stage, module, batch, pass_flops(module, batch), card.memory_bytes)

    def step(self, make: Callable[[], Step], precision: str, how: str) -> Cells:
        """Steps for about two seconds, behind four that choose kernels or compile."""
        made = make()
        train: TrainConfig = made.stage.config.train.model_copy(
            update={"precision": PRECISIONS[precision], "compile": False, "accumulate": 1}
        )
        module = copy.deepcopy(made.module).train()
        if how == "residual":
            prepare_module(module, train.model_copy(update={"residual": "bf16"}))
        if how in ("compiled", "residual"):
            size = sum(param.numel() for param in module.parameters())
            module.compile_losses(graphs=self.device.type == "cuda" and size < LAUNCHES)
        if self.device.type == "cuda":
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()
        hardware = self.recipes["humantomato"].hardware.model_copy(update={"deterministic": how != "free"})
        module.logs_rows = True
        clock = Clock(self.synchronize)
        folder = Path(tempfile.mkdtemp())
        trainer = make_trainer(
            hardware,
            train.model_copy(update={"steps": 104}),
            module,
            [clock],
            BackgroundWriter(keep=2),
            folder,
        )
        with deterministic(hardware):
            trainer.fit(module, DataLoader([tree_map(self.moved, made.batch)] * 104, batch_size=None))
        cells = {"ms a step": f"{1000 * clock.mean:.1f}", "first, s": f"{clock.first:.1f}"}
        cells |= {"batch": str(train.batch_size), "TFLOP a step": f"{made.flops / 1e12:.3g}"}
        return cells | self.share(made.flops / clock.mean, train) | self.memory(made.estimated)

    def moved(self, value: object) -> object:
        """A tensor on the device."""
        return value.to(self.device) if isinstance(value, Tensor) else value

    def share(self, reached: float, train: TrainConfig) -> Cells:
        """TFLOP/s and the share of the peak, where it is known."""
        peak = peak_flops(self.device, train.precision)
        cells = {"TFLOP/s": f"{reached / 1e12:.3g}"}
        return cells | ({} if peak is None else {"of the peak": f"{reached / peak:.1%}"})

    def memory(self, estimated: int) -> Cells:
        cells = {"dry run says, GiB": f"{estimated / 2**30:.3g}"}
        if self.device.type != "cuda":
            return cells
        return {"peak GiB": f"{torch.cuda.max_memory_allocated() / 2**30:.3g}"} | cells

    def synchronize(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize()

    def until(self, stage: str, first: str | None = None) -> Path:
        """Run a stage of the recipe and what it needs, or `first` and what is behind it again."""
        run_recipe(
            self.recipe("humantomato"),
            self.run,
            overrides=self.hardware,
            select=Selection(first=first, until=stage),
            replace=True,
            console=self.console,
        )
        return self.run / "stages" / stage

    def training(self, name: str) -> Cells:
        """A training with its loader, as its telemetry saw it."""
        rows = read_flight(self.until(name))[0]
        rows = rows[len(rows) // 3 :]
        middle = {key: statistics.median(row[key] for row in rows) for key in rows[0]}
        cells = {"ms a step": f"{1000 * middle['step_seconds']:.1f}"}
        cells |= {"samples/s": f"{middle['samples_per_second']:,.0f}"}
        cells |= {"waits for data": f"{middle['waited/data']:.1%}", "goodput": f"{middle['goodput']:.1%}"}
        return cells | ({"of the peak": f"{middle['mfu']:.1%}"} if "mfu" in middle else {})

    def again(self, name: str) -> Cells:
        """Whether a second training gives the bytes of the first."""
        before = sha256_of(self.until(name) / "model.safetensors")
        after = sha256_of(self.until(name, first=name) / "model.safetensors")
        return {"sha256": f"{before[:12]} {after[:12]}", "equal": "yes" if before == after else "no"}

    def tokens(self, make: Callable[[], Step], batch: int, half: bool) -> Cells:
        """Sequences of 17 groups of a GPT whose weights are drawn, `batch` at once."""
        net = make().module.net.to(self.device)
        text = torch.randn(batch, net.text_dim, device=self.device)
        groups = torch.full((batch,), 17)
        for seed in range(2):  # the first one compiles and records
            self.synchronize()
            begin = time.perf_counter()
            with torch.autocast(self.device.type, torch.bfloat16, enabled=half):
                draw_tokens(net, text, groups=groups, seed=seed)
            self.synchronize()
            took = time.perf_counter() - begin
        count = 17 * len(net.pattern)
        return {"ms a token": f"{1000 * took / count:.2f}", "sequences/s": f"{batch / took:.0f}"}

    def sampling(self, batch: int, half: bool) -> Cells:
        """Motions for one caption, `batch` at once, in float32 or under bfloat16's autocast."""
        bundle = Bundle.open(self.until("gpt").parents[1], self.device)
        seconds = min(FRAMES / bundle.layout.fps, bundle.max_seconds)
        for seed in range(2):  # the first one chooses kernels
            begin = time.perf_counter()
            how = {"seconds": seconds, "seed": seed}
            with torch.autocast(self.device.type, torch.bfloat16, enabled=half):
                request = Request.of(["a person walks forward"] * batch, sampling=SamplingConfig(), **how)
                made = generate(bundle, request, at_once=batch)
            self.synchronize()
            took = time.perf_counter() - begin
        return {
            "ms": f"{1000 * took:.0f}",
            "frames": str(len(made[0].joints)),
            "motions/s": f"{batch / took:.1f}",
        }

    def short(self, name: str) -> tuple[list[str], Callable[[str], Cells]]:
        """The stages of a recipe, and what runs one of them, made short."""
        settings = list(self.hardware)
        recipe = load_recipe(name)
        for stage in recipe.stages:
            fields = type(stage.config).model_fields
            settings += [f"{stage.name}.{key}={value}" for key, value in SHORT.items() if key in fields]
            if stage.kind.trains:
                train = {"steps": 20, "checkpoint_every": 20, "compile": "false"}
                settings += [f"{stage.name}.train.{key}={value}" for key, value in train.items()]
        settings += ["data.clips=400"] + ["data.dances.songs=16"] * name.endswith("ude")

        def run(until: str) -> Cells:
            select = Selection(until=until)
            out = self.args.work / name
            run_recipe(name, out, overrides=settings, select=select, replace=True, console=self.console)
            return {"runs": "yes"}

        return [stage.name for stage in recipe.stages], run


def with_values(batch: Batch, net: Any) -> Batch:
    """An example, which has shapes only, with values drawn: closed sequences of codes, and noise."""

    def drawn(value: Any) -> Any:
        return torch.randn_like(value) if isinstance(value, Tensor) and value.is_floating_point() else value

    batch = tree_map(drawn, batch)
    if "tokens" in batch:
        shape = batch["tokens"].shape
        last = len(net.ends)
        batch["tokens"] = torch.randint(int(net.ends.min()), shape)
        batch["tokens"][:, -last:] = net.ends
    return batch


def measurements(bench: Benchmark) -> Iterator[tuple[str, str, Callable[[], Cells]]]:
    """Table, title and measurement of each row, in order."""
    built: dict[str, Step] = {}

    def kept(family: str, name: str) -> Step:
        if name not in built:
            built.clear()  # the large ones do not fit beside each other
            built[name] = bench.built(family, name)
        return built[name]

    stepped = [(family, name) for family, names in STEPPED.items() for name in names]
    for family, name in stepped:
        for precision in PRECISIONS:
            make = partial(kept, family, name)
            yield "steps", f"{name} {precision}", partial(bench.step, make, precision, "eager")
        yield "steps", f"{name} bf16, free", partial(bench.step, make, "bf16", "free")
    for name in TRAINED:
        yield "trainings", name, partial(bench.training, name)
    drawn = partial(bench.tokens, partial(kept, "humantomato", "gpt"))
    for table, draw in {"tokens": drawn, "sampling": bench.sampling}.items():
        for batch in (1, 32, 256, 1024):
            for half in (False, True):
                yield table, f"{batch} at once, {'bf16' if half else 'fp32'}", partial(draw, batch, half)
    for name in ("tokenizer", "gpt"):
        yield "bytes", name, partial(bench.again, name)
    for recipe in ("baselines-tiny", "baselines-tiny-ude"):
        names, run = bench.short(recipe)
        for name in names:
            yield "stages", f"{recipe} {name}", partial(run, name)
    for family, name in stepped:
        yield "compiled", f"{name} bf16", partial(bench.step, partial(kept, family, name), "bf16", "compiled")
    make = partial(kept, "humantomato", "gpt")
    yield "compiled", "gpt, residual bf16", partial(bench.step, make, "bf16", "residual")


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--size", choices=("paper", "small", "tiny"), default="paper")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--minutes", type=float, default=10.0, help="after which no row is begun")
    parser.add_argument("--steps", type=int, default=300, help="of each training; from 100 on with workers")
    parser.add_argument("--only", nargs="+", default=[], metavar="ROWS")
    args = arguments(parser)
    args.work.mkdir(parents=True, exist_ok=True)
    rows = Rows(args.work / "rows.jsonl", args.minutes, args.only)
    bench = Benchmark(args)
    for table, title, cells in measurements(bench):
        rows.measure(table, title, cells)
    named = torch.cuda.get_device_name(bench.device) if bench.device.type == "cuda" else "CPU"
    for table in dict.fromkeys(row["table"] for row in rows.rows):
        own = [row for row in rows.rows if row["table"] == table]
        columns = [Column(name, name) for name in dict.fromkeys(key for row in own for key in row["cells"])]
        name = args.record and f"{args.record}_{table}"
        report(f"{table}: {named}, torch {torch.__version__}, sizes {args.size}", columns, own, name)
    if rows.left_out:
        print(f"no time was left for {len(rows.left_out)} rows: {'; '.join(rows.left_out)}", flush=True)


if __name__ == "__main__":
    main()
