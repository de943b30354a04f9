"""Fixtures of the numeric tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch


@pytest.fixture
def float64() -> Iterator[None]:
    """Networks and random inputs in float64: two ways to one result then agree to far below any bound here,
    whatever instructions and number of threads the machine sums with. What a network returns may still be
    rounded to float32."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)
