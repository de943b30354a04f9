"""Trainings whose losses torch compiles: signals, failures, graphs that are kept."""

from __future__ import annotations

import os
import signal
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from same_stage import assert_same_stage
from ude_training import train

from motionloom.models.training import compiled
from motionloom.pipeline.launch.process import Interrupted

pytestmark = pytest.mark.slow

Backend = str | Callable[[Any, Any], Any]


@pytest.fixture
def compile_by(monkeypatch: pytest.MonkeyPatch) -> Callable[[Backend], None]:
    """`compile_by(backend)`: torch compiles by it, from the first graph on."""
    compiler = torch.compile

    def put(backend: Backend) -> None:
        monkeypatch.setattr(
            torch, "compile", lambda losses, **_: compiler(losses, backend=backend, fullgraph=True)
        )
        monkeypatch.setattr(compiled.Compiled, "_structure", "")

    return put


@pytest.mark.parametrize(("graph", "ends_at"), [(1, 0), (2, 2)])
def test_a_signal_while_it_compiles(
    graph: int, ends_at: int, compile_by: Callable[[Backend], None], tmp_path: Path
) -> None:
    """At once where no step would be lost, else after the step, which is saved. The second graph is that of
    the second step: the first one has filled the codebook."""
    begun, ended = [], []

    def slow(graph_module: Any, inputs: Any) -> Any:
        begun.append(1)
        if len(begun) == graph:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.2)
        ended.append(1)
        return graph_module

    compile_by(slow)
    with pytest.raises(Interrupted) as stopped:
        train("mq", tmp_path / "hit", compile=True)
    assert stopped.value.step == ends_at and len(begun) == graph
    assert len(ended) == (0 if ends_at == 0 else graph)
    again = train("mq", tmp_path / "hit", compile=True)
    compile_by(lambda graph_module, inputs: graph_module)
    assert_same_stage(
        tmp_path / "whole", tmp_path / "hit", train("mq", tmp_path / "whole", compile=True), again
    )


@pytest.mark.parametrize("name", ["mq", "utt"])
def test_what_cannot_be_compiled_is_trained_without(
    name: str, compile_by: Callable[[Backend], None], tmp_path: Path
) -> None:
    """With one warning, and the bytes of a training that was never compiled."""

    def broken(graph_module: Any, inputs: Any) -> Any:
        torch.rand(3)  # draws of the compiler must not count
        raise ArithmeticError("no kernel for this")

    compile_by(broken)
    plain = train(name, tmp_path / "plain", dropout=0.1)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        module = train(name, tmp_path / "failed", dropout=0.1, compile=True)
    (only,) = [str(one.message) for one in said if "torch.compile" in str(one.message)]
    assert "no kernel for this" in only
    for key, value in module.state_dict().items():
        assert torch.equal(value, plain.state_dict()[key]), key


def test_graphs_are_kept_for_the_same_network(compile_by: Callable[[Backend], None], tmp_path: Path) -> None:
    made = []

    def counting(graph_module: Any, inputs: Any) -> Any:
        made.append(1)
        return graph_module

    compile_by(counting)
    counts = []
    for folder, name in enumerate(("dmd", "dmd", "mq", "dmd")):
        train(name, tmp_path / str(folder), dropout=0.1, compile=True)
        counts.append(len(made))
    first, again, other, back = counts
    assert again == first > 0, "the same network needs no new graph"
    assert back - other == first, "those of another network are dropped"
