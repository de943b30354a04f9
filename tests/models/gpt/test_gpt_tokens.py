"""Interleaving: against a slow reference for any pattern."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from motionloom.models.gpt.tokens import PAD, as_codes, closing_length, interleave, stream_names

PATTERNS = st.lists(st.sampled_from(["a", "b", "c"]), min_size=1, max_size=5).map(tuple)


def random_codes(
    pattern: tuple[str, ...], batch: int, groups: int, seed: int
) -> tuple[dict[str, torch.Tensor], dict[str, int]]:
    generator = torch.Generator().manual_seed(seed)
    ends = {name: 3 + 2 * i for i, name in enumerate(stream_names(pattern))}
    codes = {
        name: torch.randint(0, ends[name], (batch, groups * pattern.count(name)), generator=generator)
        for name in ends
    }
    return codes, ends


def reference(
    codes: dict[str, torch.Tensor], pattern: tuple[str, ...], ends: dict[str, int], row: int, groups: int
) -> list[tuple[int, int]]:
    """(token, kind) one by one, each stream read through its own iterator."""
    names = list(dict.fromkeys(pattern))
    streams = {name: iter(codes[name][row].tolist()) for name in names}
    out = [(next(streams[name]), names.index(name)) for _ in range(groups) for name in pattern]
    return out + [(ends[name], k) for k, name in enumerate(names)]


@settings(max_examples=60, deadline=None)
@given(pattern=PATTERNS, groups=st.lists(st.integers(1, 6), min_size=1, max_size=4), seed=st.integers(0, 999))
def test_interleave_equals_reference_and_inverts(
    pattern: tuple[str, ...], groups: list[int], seed: int
) -> None:
    codes, ends = random_codes(pattern, len(groups), max(groups), seed)
    out = interleave(codes, pattern, ends=ends, groups=torch.tensor(groups))
    for row, count in enumerate(groups):
        expected = reference(codes, pattern, ends, row, count)
        assert out.length[row] == len(expected) == count * len(pattern) + closing_length(pattern)
        size = len(expected)
        assert (
            list(zip(out.tokens[row, :size].tolist(), out.kinds[row, :size].tolist(), strict=True))
            == expected
        )
        assert (out.tokens[row, size:] == PAD).all()
        assert (out.kinds[row, size:] == 0).all()
    most = max(groups)
    back = as_codes(
        out.tokens[:, : most * len(pattern)].view(len(groups), most, -1), pattern, torch.tensor(groups)
    )
    assert back.groups.tolist() == groups
    for name in ends:
        per_group = pattern.count(name)
        for row, count in enumerate(groups):
            valid = count * per_group
            assert torch.equal(back.codes[name][row, :valid], codes[name][row, :valid])
            assert (back.codes[name][row, valid:] == 0).all()
    closed = torch.arange(len(groups)) % 2 == seed % 2  # the other rows are clips that go on
    some = interleave(codes, pattern, ends=ends, groups=torch.tensor(groups), closed=closed)
    assert some.length.tolist() == [
        size if closed[row] else size - len(ends) for row, size in enumerate(out.length.tolist())
    ]
    for row, size in enumerate(some.length.tolist()):
        assert torch.equal(some.tokens[row, :size], out.tokens[row, :size])
        assert torch.equal(some.kinds[row, :size], out.kinds[row, :size])
        assert (some.tokens[row, size:] == PAD).all() and (some.kinds[row, size:] == 0).all()
    opened = interleave(codes, pattern, groups=torch.tensor(groups))
    assert torch.equal(opened.length + len(ends), out.length)


def test_mistakes_are_named() -> None:
    codes = {"a": torch.tensor([[0, 1, 2, 3]]), "b": torch.tensor([[0]])}
    with pytest.raises(ValueError, match="'b' holds 1 codes"):
        interleave(codes, ("a", "a", "b"))
