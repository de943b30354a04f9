"""Every stage's loss is one graph for torch.compile, and gives the same figures as without."""

from __future__ import annotations

import copy
import warnings
from contextlib import nullcontext
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import torch
from plain_training import take_steps
from rank_cases import CASES, Undrawn, drawing_mdm, rows_of
from torch import nn
from ude_training import train

from motionloom.models.layers.attention import SelfAttention
from motionloom.models.training import compiled
from motionloom.models.training.stage_module import StageModule

pytestmark = pytest.mark.slow

ONCE = {case: make for case, make in CASES.items() if "," not in case} | {"mdm": drawing_mdm}


@pytest.mark.parametrize("case", sorted(ONCE.keys() - {"evaluator", "seq2seq"}))  # torch.compile takes no GRU
def test_one_graph_and_the_same_losses_and_gradients(case: str) -> None:
    torch._dynamo.reset()
    torch.manual_seed(0)
    module, batches = ONCE[case]()
    batch = batches(0)
    module.double().train()
    for part in module.modules():  # compiled code may draw in another order
        if isinstance(part, nn.Dropout):
            part.p = 0.0
        elif isinstance(part, SelfAttention):
            part.attention_dropout = 0.0
    twin = copy.deepcopy(module)
    torch.manual_seed(1)
    # First, as in a training: nothing has been cached by plain Python yet.
    found = torch.compile(losses_of(module), fullgraph=True, backend="aot_eager")(batch)
    torch.manual_seed(1)
    plain = losses_of(twin)(batch)
    assert found.keys() == plain.keys()
    for name, value in plain.items():
        torch.testing.assert_close(
            found[name], value, atol=1e-5, rtol=1e-4, msg=lambda m, n=name: f"{n}: {m}"
        )
    for values in (found, plain):
        values["loss"].backward()
    for (name, own), other in zip(module.net.named_parameters(), twin.net.parameters(), strict=True):
        assert not own.requires_grad or own.grad is not None, name
        torch.testing.assert_close(own.grad, other.grad, atol=1e-5, rtol=1e-3)


def losses_of(module: StageModule) -> Any:
    """With its own draws."""
    return super(Undrawn, module).losses if isinstance(module, Undrawn) else module.losses


def test_many_stages_compile_in_one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recipe's tokenizers share the code of their losses, of which only so many graphs may exist."""
    compiler = torch.compile
    monkeypatch.setattr(torch, "compile", lambda f, **_: compiler(f, backend="eager", fullgraph=True))
    monkeypatch.setattr(compiled, "GRAPHS", 4)
    for kind in ("rvq", "fsq"):
        module, batches = CASES[kind]()
        module.double().compile_losses()
        for size in (4, 3):
            for mode in (True, False):
                module.train(mode)
                assert module.losses(rows_of(batches(0), slice(size)))["loss"] > 0
        assert module.losses.compiled is not module.losses.losses, "none has failed"  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ["tm2t", "utt"])
def test_no_step_of_players_is_compiled_anew(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over more steps than there may be graphs, while a critic begins and its weight rises."""
    compiler = torch.compile
    monkeypatch.setattr(torch, "compile", lambda f, **_: compiler(f, backend="eager", fullgraph=True))
    monkeypatch.setattr(compiled, "GRAPHS", 8)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "torch.compile failed")
        assert train(name, tmp_path, compile=True, validate_every=0).step == 16


def test_a_graph_that_fails_in_its_third_backward_pass_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """With one warning, and all that three steps without it make: weights, codebooks, figures. Texts come to
    it in multiples of sixteen words."""
    calls = count(1)

    def third_fails(losses: Any, **_: Any) -> Any:
        def called(batch: Any) -> Any:
            values, texts = losses(batch), batch.get("conditions", {})
            assert all(text.mask.shape[1] % compiled.WORD_MULTIPLE == 0 for text in texts.values())
            if next(calls) == 3:
                values["loss"].register_hook(failing)
            return values

        return called

    monkeypatch.setattr(torch, "compile", third_fails)
    for kind in ("rvq", "tma"):
        made = []
        for graphs in (False, True):
            torch.manual_seed(0)
            module, batches = CASES[kind]()
            calls = count(1)
            if graphs:
                module.compile_losses(graphs=True)
            with pytest.warns(UserWarning, match="nothing to replay") if graphs else nullcontext():
                loss = take_steps(module.double(), [batches(k) for k in range(5)])
            figures = [(one.step, one.values) for one in module.figures]
            made.append([loss, figures, list(module.state_dict().values())])
        assert len(made[1][1]) == 5
        torch.testing.assert_close(
            made[0], made[1], rtol=0 if kind == "rvq" else 1e-4, atol=1e-6 * (kind != "rvq")
        )


def failing(*_: Any, **__: Any) -> Any:
    torch.rand(3)
    raise RuntimeError("CUDA error: nothing to replay")


def test_graphs_that_fail_as_they_run_are_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """With one warning, and the same draws."""
    module, batches = drawing_mdm()
    plain, found = module.double().losses, []
    monkeypatch.setattr(torch, "compile", lambda *_, **__: failing)
    module.compile_losses(graphs=True)
    with pytest.warns(UserWarning, match="nothing to replay") as said:
        for losses in (plain, module.losses, module.losses):
            torch.manual_seed(5)
            found.append(losses(batches(0))["loss"].item())
    assert found[0] == found[1] == found[2]
    assert sum("nothing to replay" in str(one.message) for one in said) == 1
