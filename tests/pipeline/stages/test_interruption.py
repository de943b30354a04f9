"""A signal in the middle of a training: it saves the step that it is at, and goes on as if nothing had been.

`test_goes_on.py` has the same on two ranks.
"""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from safetensors.torch import load_file
from same_stage import assert_same_stage
from tiny_adversaries import train
from torch import Tensor
from ude_training import train as train_dances

from motionloom.pipeline.cli import main as program
from motionloom.pipeline.launch.process import SAVED, Interrupted
from motionloom.pipeline.store.training_log import read_training_log
from motionloom.pipeline.training import preemption as interruption
from motionloom.pipeline.training.preemption import SIGNALS, Agreement, Signals, signals_blocked

# Rows end with every tenth step, so none of these borders and interruptions lies where a row does.
FULL: dict[str, Any] = {"ema": 0.9, "accumulate": 2, "checkpoint_every": 7, "validate_every": 7}
TERM, USR1, USR2 = signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2


def train_codes(folder: Path, **settings: Any) -> Any:
    """Learnt codebooks, whose idle codes are drawn anew."""
    return train_dances("dance_vq", folder, **{"steps": 24, **settings})


Train = Callable[..., Any]


@pytest.mark.parametrize("training", [train, train_codes], ids=["two optimizers", "codebooks"])
def test_interrupted_equals_undisturbed(training: Train, tmp_path: Path) -> None:
    """In the middle of chunks, of rows of the log, and where the last chunk is cut short."""
    whole = training(tmp_path / "whole", **FULL)
    for at, number in ((8, TERM), (11, USR1), (16, USR2), (22, TERM)):
        with pytest.raises(Interrupted) as stopped:
            training(tmp_path / "hit", signalled={at: number}, **FULL)
        stop = stopped.value
        assert (stop.step, stop.steps, stop.signal) == (at + 1, 24, number.name)
        assert max((tmp_path / "hit/checkpoints").iterdir()).name == f"step={at + 1:08d}.ckpt"
        steps = [row["step"] for row in read_training_log(tmp_path / "hit")]
        assert steps == [
            row["step"] for row in read_training_log(tmp_path / "whole") if row["step"] <= at + 1
        ]
    again = training(tmp_path / "hit", **FULL)
    assert_same_stage(tmp_path / "whole", tmp_path / "hit", whole, again)


@pytest.mark.parametrize("training", [train, train_codes], ids=["two optimizers", "codebooks"])
def test_a_validation_is_cut_short_and_made_up_for(training: Train, tmp_path: Path) -> None:
    """Behind its current batch, at the ends of chunks and of the training."""
    whole = training(tmp_path / "whole", **FULL | {"steps": 21})
    rows = read_training_log(tmp_path / "whole")
    for at in (6, 13, 20):
        with pytest.raises(Interrupted) as stopped:
            training(tmp_path / "hit", signalled={at: TERM}, **FULL | {"steps": 21})
        assert stopped.value.step == at + 1
        cut = [row for row in rows if row["step"] <= at + ("val/loss" not in row)]
        assert read_training_log(tmp_path / "hit") == cut
        assert len([row for row in cut if "val/loss" in row]) == at // 7
    again = training(tmp_path / "hit", **FULL | {"steps": 21})
    assert_same_stage(tmp_path / "whole", tmp_path / "hit", whole, again)


def test_ctrl_c_ends_at_once_and_is_not_turned_off(tmp_path: Path) -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            train(tmp_path / "hit", signalled={8: signal.SIGINT}, **FULL)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    again, whole = train(tmp_path / "hit", **FULL), train(tmp_path / "whole", **FULL)
    assert_same_stage(tmp_path / "whole", tmp_path / "hit", whole, again)


def test_signals_are_noted_and_the_first_counts() -> None:
    before = {number: signal.getsignal(number) for number in SIGNALS}
    with Signals() as signals:
        assert signals.number == 0
        for number in (USR1, TERM):
            signal.raise_signal(number)
        assert signals.number == USR1
        signals.answered = True
    assert {number: signal.getsignal(number) for number in SIGNALS} == before


def test_a_signal_that_comes_too_late_is_passed_on() -> None:
    seen: list[int] = []
    before = signal.signal(USR2, lambda number, _: seen.append(number))
    try:
        with Signals():
            signal.raise_signal(USR2)
            assert seen == []
        assert seen == [USR2]
        with pytest.raises(ValueError), Signals():  # an error says more
            signal.raise_signal(USR2)
            raise ValueError
        assert seen == [USR2]
    finally:
        signal.signal(USR2, before)


def test_processes_started_unsignalled_outlive_their_group() -> None:
    with Signals() as signals:
        with signals_blocked():
            child = subprocess.Popen(["sleep", "60"], stdin=subprocess.DEVNULL)
            signal.raise_signal(USR1)
            assert signals.number == 0
        assert signals.number == USR1  # what came meanwhile is delivered behind it
        signals.answered = True
    try:
        for number in SIGNALS:
            child.send_signal(number)
        with pytest.raises(subprocess.TimeoutExpired):
            child.wait(0.2)
    finally:
        child.kill()
        child.wait()


def test_ranks_ask_each_other_about_twice_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """At steps that follow from the slowest rank's clock alone."""
    clock = [0.0]
    asked: list[tuple[int, float]] = []

    def all_reduce(both: Tensor, *_: Any) -> None:
        both[1] = both[1] * 2  # another rank is twice as slow
        both[0] = max(float(both[0]), 15.0 if step >= 400 else 0.0)

    monkeypatch.setattr(interruption.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(interruption.dist, "new_group", lambda **_: object())
    monkeypatch.setattr(interruption.dist, "all_reduce", all_reduce)
    agreement = Agreement(Signals(), world=2)
    for step in range(1, 1000):
        clock[0] += 1 / 256
        before = agreement._last
        number = agreement.after_step()
        if agreement._last != before:
            asked.append((step, clock[0]))
        if number:
            break
    assert number == 15 and 400 <= step <= 450
    gaps = [later[0] - sooner[0] for sooner, later in pairwise(asked)]
    assert gaps[:3] == [4, 16, 64] and set(gaps[2:]) == {64}  # half a second of 1/128 each


def test_the_program_says_how_to_go_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(**_: Any) -> None:
        raise Interrupted("tokenizer", 37, 100, "SIGTERM")

    monkeypatch.setattr(program, "app", stop)
    monkeypatch.setattr(sys, "argv", ["/bin/motionloom", "run", "a recipe.yaml"])
    assert program._exit_code() == SAVED == 75
    error = capsys.readouterr().err
    assert "tokenizer" in error and "step 37 of 100" in error and "motionloom run 'a recipe.yaml'" in error
    monkeypatch.setenv("LOCAL_RANK", "1")  # a process of Lightning's launcher
    assert program._exit_code() == 0 and capsys.readouterr().err == ""
    monkeypatch.setenv("RANK", "1")  # one of torchrun's
    assert program._exit_code() == SAVED


# A GPT stage that starts from another's weights and aligns the motions it samples, as a user runs it.

MORE: dict[str, Any] = {
    "kind": "gpt",
    "inputs": {"start": "gpt"},
    "net": {"layers": 1, "dim": 48, "heads": 4, "ff": 96},
    "loss": {"align_on": "samples", "align_weight": 1.0},
    "optim": {"lr": 1e-12, "weight_decay": 0.0},
    "train": {"steps": 4, "batch_size": 8, "checkpoint_every": 2, "validate_every": 2},
}


@pytest.fixture
def run(small_run: Any, tmp_path: Path, call: Callable[..., Any]) -> Callable[..., tuple[Any, Path]]:
    """`run(loss={...}) -> (outcome, folder)`: the stage `more` on a copy of the finished run."""
    folder = tmp_path / "run"
    shutil.copytree(small_run.folder, folder)

    def go(*arguments: str, **changes: Any) -> tuple[Any, Path]:
        recipe = yaml.safe_load(small_run.recipe.read_text())
        net = recipe["stages"]["gpt"]["net"]
        tiny = yaml.safe_load((Path(__file__).parents[3] / "configs/humantomato/tiny.yaml").read_text())
        more = {**MORE, "net": {**tiny["stages"]["gpt"]["net"], **net}, **changes}
        recipe["stages"]["more"] = more
        path = tmp_path / "more.yaml"
        path.write_text(yaml.safe_dump(recipe))
        return call("run", path, "--out", folder, "--until", "more", *arguments), folder / "stages/more"

    return go


def test_a_stage_starts_from_anothers_weights(run: Callable[..., tuple[Any, Path]]) -> None:
    """With steps too small to see, they are the same; the alignment of samples is logged and validated."""
    outcome, folder = run()
    assert outcome.code == 0, outcome.err
    before = load_file(folder.parent / "gpt/model.safetensors")
    after = load_file(folder / "model.safetensors")
    torch.testing.assert_close(after, before, rtol=0, atol=1e-9)
    rows = [row for row in read_training_log(folder) if "val/align" in row]
    assert [row["step"] for row in rows] == [2, 4]
    assert rows[0]["val/align"] == pytest.approx(rows[1]["val/align"], rel=1e-3)
    assert 0 < rows[0]["val/align"] < 20


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"net": {**MORE["net"], "heads": 2}}, "in net.heads;"),
        ({"prior": "sentence"}, "in prior;"),
        ({"inputs": {"start": "face_gpt"}}, "in net.ff, net.dim, prior, inputs.tokenizer, inputs.tma;"),
        ({"inputs": {"start": "tma"}}, "gpt or face_gpt"),
        # Motions are sampled token by token.
        ({"train": {**MORE["train"], "compile": True}}, "token by token"),
        ({"train": {**MORE["train"], "strategy": "fsdp"}}, "token by token"),
    ],
)
def test_what_cannot_train_is_refused_before_anything_runs(
    run: Callable[..., tuple[Any, Path]], changes: dict[str, Any], says: str
) -> None:
    outcome, _ = run("--dry-run", **changes)
    assert outcome.code == 2
    assert says in " ".join(outcome.err.split())
