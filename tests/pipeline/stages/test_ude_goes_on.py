"""Trainings of UDE, FACT and Bailando stop and go on: after a kill bit for bit, and on two ranks as on one.

MQ with its codebook learnt by gradient, MATE + UTT against a critic with spectral norm, the DMD, and the
models of dances. The processes of the two ranks run this file as a script.
"""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import pytest
import torch
from same_stage import assert_kills_change_nothing, assert_ranks_equal_one
from two_ranks import pair_of, work
from ude_training import NAMES, train


@pytest.mark.parametrize("name", NAMES)
def test_killed_twice_equals_undisturbed(name: str, tmp_path: Path) -> None:
    """With dropout, z, dropped conditions and drawn tokens; the first kill is before the critic begins."""
    assert_kills_change_nothing(partial(train, name), tmp_path, (3, 9), 8, dropout=0.2)


# ---- two ranks

PAIRS = {name: torch.float32 if name == "utt" else torch.float64 for name in NAMES}
"""UTT's logits are float32 in any case, and its decoder reads what comes of them."""
BOUND = 1e-5


def worker(out: Path) -> None:
    for name, dtype in PAIRS.items():
        module = train(name, out / name, dtype=dtype, devices=2)
        torch.save(module.state_dict(), out / f"{name}-{os.environ['RANK']}.pt")


pair = pair_of(__file__)


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("name", list(PAIRS))
def test_two_ranks_equal_one(name: str, pair: Path, tmp_path: Path) -> None:
    one = train(name, tmp_path, dtype=PAIRS[name])
    assert_ranks_equal_one(one, tmp_path, pair, name, BOUND)


if __name__ == "__main__":
    work(worker)
