"""Trainings of UDE, FACT and Bailando stop and go on: after a kill bit for bit, and on two ranks as on one.

MQ with its codebook learnt by gradient, MATE + UTT against a critic with spectral norm, the DMD, and the
models of dances. The processes of the two ranks run this file as a script.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
import torch
from same_stage import assert_equal, newest
from torch import Tensor
from two_ranks import run_two_ranks
from ude_training import NAMES, train

from motionloom.pipeline.store.training_log import read_training_log


@pytest.mark.parametrize("name", NAMES)
def test_killed_twice_equals_undisturbed(name: str, tmp_path: Path) -> None:
    """With dropout, z, dropped conditions and drawn tokens; the first kill is before the critic begins."""
    whole = train(name, tmp_path / "whole", dropout=0.2)
    for step in (3, 9):
        with pytest.raises(ConnectionResetError):
            train(name, tmp_path / "killed", dies_at=step, dropout=0.2)
    assert newest(tmp_path / "killed")["global_step"] == 8
    again = train(name, tmp_path / "killed", dropout=0.2)
    assert_equal(again.state_dict(), whole.state_dict())
    assert_equal(newest(tmp_path / "killed"), newest(tmp_path / "whole"))
    assert read_training_log(tmp_path / "killed") == read_training_log(tmp_path / "whole")


# ---- two ranks

PAIRS = {name: torch.float32 if name == "utt" else torch.float64 for name in NAMES}
"""UTT's logits are float32 in any case, and its decoder reads what comes of them."""
BOUND = 1e-5


def worker(out: Path) -> None:
    torch.set_num_threads(1)
    for name, dtype in PAIRS.items():
        module = train(name, out / name, dtype=dtype, devices=2)
        torch.save(module.state_dict(), out / f"{name}-{os.environ['RANK']}.pt")
    torch.distributed.barrier()
    os._exit(0)  # without destructors, as the program does


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders of the trainings on two ranks."""
    folder = tmp_path_factory.mktemp("pair")
    run_two_ranks(__file__, folder)
    return folder


def meant(name: str, value: Tensor) -> Tensor:
    """Without the keys' biases: they change no softmax, so their gradients are rounding, which Adam makes
    whole steps of.
    """
    if not name.endswith("qkv.bias"):
        return value
    query, _, values = value.chunk(3)
    return torch.cat([query, values])


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("name", list(PAIRS))
def test_two_ranks_equal_one(name: str, pair: Path, tmp_path: Path) -> None:
    one = train(name, tmp_path, dtype=PAIRS[name])
    first, second = (torch.load(pair / f"{name}-{rank}.pt", weights_only=True) for rank in range(2))
    assert_equal(first, second)
    for key, value in one.state_dict().items():
        torch.testing.assert_close(
            *(meant(key, weight) for weight in (first[key], value)),
            rtol=BOUND, atol=BOUND, msg=lambda m, k=key: f"{k}: {m}",
        )  # fmt: skip
    rows = [read_training_log(folder) for folder in (tmp_path, pair / name)]
    assert [sorted(row) for row in rows[0]] == [sorted(row) for row in rows[1]]
    for row, other in zip(*rows, strict=True):
        assert other == pytest.approx(row, rel=1e-5, abs=1e-5)


if __name__ == "__main__":
    worker(Path(sys.argv[1]))
