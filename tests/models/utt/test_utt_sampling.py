"""Sampling from the UTT: windows, continuation, seeds, batches, lengths, guidance."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
import torch
from toy_gpt import PATTERN, STREAMS, encoded, random_codes, row_of

from motionloom.datasets.base.errors import UserError
from motionloom.models.condition.mate import Encoded
from motionloom.models.gpt.rows import Drawing
from motionloom.models.gpt.sampling import sample_seeds
from motionloom.models.gpt.tokens import Codes, interleave
from motionloom.models.utt.network import Utt, UttConfig
from motionloom.models.utt.sampling import draw_z, generate, join, last_groups, window_start

TINY = UttConfig(layers=2, dim=16, heads=4, ff=32, block_size=14, dropout=0.0, attention_dropout=0.0, z_dim=3)


@pytest.fixture(params=["gpt", "gru", "gpt beside"])
def utt(request: pytest.FixtureRequest) -> Utt:
    torch.manual_seed(0)
    kind, *beside = request.param.split()
    config = TINY.model_copy(update={"kind": kind, "frame_condition": bool(beside)})
    net = Utt(config, STREAMS, PATTERN, glob_dim=6, stride=2)
    if net.frame_condition_in is not None:
        torch.nn.init.normal_(net.frame_condition_in.weight, std=0.7)
    for head in net.heads:
        torch.nn.init.normal_(head.weight, std=0.7)  # peaked, so that a mixed-up draw would show
    torch.nn.init.normal_(net.condition_in.weight, std=2.0)
    net.heads[0].bias.data[-1] = 2.0  # End is likely
    return net.double()


conditions = partial(encoded, timed=True)


def null(batch: int) -> Encoded:
    zero = torch.full((batch, 6), 0.3, dtype=torch.float64)
    return Encoded(zero, zero.new_zeros(batch, 0, 6), torch.zeros(batch, 0, dtype=torch.bool))


@torch.no_grad()
def slow(
    utt: Utt, condition: Encoded, seed: int, groups: int, *, start: list[int], guide: Encoded | None = None,
    scale: float = 1.0, **settings: Any,
) -> list[int]:  # fmt: skip
    """One row without a cache: every token from a full pass over its window."""
    utt.eval()
    import numpy as np

    uniform = np.random.Generator(np.random.Philox(key=seed)).random(groups * 3)
    z = draw_z([seed], 3)
    tokens = list(start)
    for i in range(groups * 3):
        first = window_start(len(tokens), 14, 3)
        window = torch.tensor([[*tokens[first:], 0]])
        kinds = utt.slots[torch.arange(window.shape[1]) % 3][None]
        # Music two positions a group, behind the groups that have slid out; none for the guide.
        assert condition.timed is not None
        timed = (condition.timed[:, first // 3 * 2 :], None)
        both = zip((condition, guide), timed, strict=True)
        logits = [utt(window, kinds, c._replace(timed=t), z)[:, -1] for c, t in both if c is not None]
        logits = [x.scatter(1, utt.ends[kinds[:, -1:]], -torch.inf) for x in logits]
        mixed = logits[0] if guide is None else logits[1] + scale * (logits[0] - logits[1])
        mixed = torch.where(torch.isfinite(logits[0]), mixed, -torch.inf)
        tokens.append(int(Drawing(**settings)(mixed, torch.tensor([uniform[i]]))))
    return tokens[len(start) :]


def test_window_slides_by_halves_when_full() -> None:
    starts = [window_start(n, 14, 3) for n in range(30)]
    assert starts[:14] == [0] * 14
    assert starts[14] == 6  # a block of 14 holds four groups of 3; two of them go
    for n in range(1, 30):
        first = starts[n]
        assert first % 3 == 0
        assert n - first + 1 <= 14
        assert first == starts[n - 1] or n - first + 1 > 14 - 6 - 3
    assert window_start(10_000, 160, 1) + 160 > 10_000


@pytest.mark.parametrize(
    ("groups", "scale", "settings"),
    [
        *((n, 1.0, how) for n in (3, 11) for how in ({}, {"temperature": 0})),
        (11, 1.0, {"top_k": 3, "top_p": 0.8, "temperature": 1.3}),
        (6, 3.0, {"temperature": 0.8}),
    ],
)
def test_cached_equals_uncached_over_several_windows(
    utt: Utt, groups: int, scale: float, settings: dict[str, Any]
) -> None:
    condition, seeds, count = conditions(2, [5, 2]), sample_seeds(7, 2), torch.full((2,), groups)
    given: dict[str, Any] = {"cfg_scale": scale, "how": Drawing(**settings)}
    out = generate(utt, condition, null=null(2), groups=count, seed=7, **given)
    sequence = interleave(out.codes, PATTERN, groups=out.groups)
    guide = None if scale == 1 else null(1)
    for index in range(2):
        mine = condition.rows(slice(index, index + 1))
        wanted = slow(utt, mine, seeds[index], groups, start=[], guide=guide, scale=scale, **settings)
        assert sequence.tokens[index].tolist() == wanted


def test_continues_given_tokens_of_different_lengths(utt: Utt) -> None:
    start, groups = random_codes([2, 6, 0, 9]), torch.tensor([4, 2, 5, 1])
    condition, seeds = conditions(4, [5, 2, 0, 3]), sample_seeds(5, 4)
    out = generate(utt, condition, start=start, groups=groups, seed=5)
    assert out.groups.tolist() == groups.tolist()
    given, counts = last_groups(start, PATTERN)
    new = interleave(out.codes, PATTERN, groups=out.groups)
    for index in range(4):
        mine = condition.rows(slice(index, index + 1))
        before = given[index, : 3 * int(counts[index])].tolist()
        expected = slow(utt, mine, seeds[index], int(groups[index]), start=before)
        assert new.tokens[index, : int(new.length[index])].tolist() == expected
    other = generate(utt, condition, groups=groups, seed=5)
    assert any(row_of(other, i) != row_of(out, i) for i in (0, 1, 3))
    assert row_of(other, 2) == row_of(out, 2)  # the row that has no start


def test_context_limits_what_is_read_of_the_start(utt: Utt) -> None:
    start, groups, condition = random_codes([6, 4]), torch.tensor([3, 3]), conditions(2)
    short = Codes(
        {s.name: torch.stack([start.codes[s.name][i, (n - 2) * s.per_group : n * s.per_group]
                              for i, n in enumerate((6, 4))]) for s in STREAMS},
        torch.tensor([2, 2]),
    )  # fmt: skip
    a = generate(utt, condition, start=start, context=2, groups=groups, seed=1)
    b = generate(utt, condition, start=short, groups=groups, seed=1)
    assert all(row_of(a, i) == row_of(b, i) for i in range(2))
    c = generate(utt, condition, start=start, context=0, groups=groups, seed=1)
    assert all(row_of(c, i) == row_of(generate(utt, condition, groups=groups, seed=1), i) for i in range(2))


def test_join_of_rows_of_different_lengths() -> None:
    a, b = random_codes([2, 5, 0]), random_codes([4, 1, 3])
    both = join(a, b, PATTERN)
    assert both.groups.tolist() == [6, 6, 3]
    for index in range(3):
        assert row_of(both, index) == {
            name: values + row_of(b, index)[name] for name, values in row_of(a, index).items()
        }
    assert (both.codes["body"][2, 6:] == 0).all()


@pytest.mark.parametrize("scale", [1.0, 2.5, [1.0, 3.0, 1.0, 1.5, 2.5, 1.0]])
def test_alone_equals_in_a_batch(utt: Utt, scale: float | list[float]) -> None:
    """Also where every row has its own guidance."""
    condition, seeds = conditions(6, [5, 0, 2, 5, 1, 3]), sample_seeds(3, 6)
    start = random_codes([2, 0, 1, 3, 5, 0])
    settings: dict[str, Any] = {"null": null(6), "start": start, "max_groups": 8, "cfg_scale": scale}
    together = generate(utt, condition, seed=3, **settings)
    assert len(set(together.groups.tolist())) > 1
    assert together.groups.min() >= 1
    for index in range(6):
        mine = slice(index, index + 1)
        codes = Codes({name: values[mine] for name, values in start.codes.items()}, start.groups[mine])
        own = scale[index] if isinstance(scale, list) else scale
        settings |= {"null": null(1), "start": codes, "cfg_scale": own}
        alone = generate(utt, condition.rows(mine), seed=[seeds[index]], **settings)
        assert row_of(alone, 0) == row_of(together, index)
    settings |= {"null": null(6), "start": start, "cfg_scale": scale}
    other = generate(utt, condition, seed=4, **settings)
    assert any(row_of(other, i) != row_of(together, i) for i in range(6))


def test_z_makes_samples_differ_and_is_the_seeds_alone(utt: Utt) -> None:
    condition = Encoded(*(x[:1].expand(8, *x.shape[1:]) for x in conditions(1)[:4]))
    groups = torch.full((8,), 4)
    with torch.no_grad():
        assert utt.z_in is not None
        utt.z_in[-1].weight.mul_(30)
        if utt.frame_condition_in is not None:
            utt.frame_condition_in.weight.mul_(0.1)
    noisy = generate(utt, condition, groups=groups, how=Drawing(0))
    still = generate(utt, condition, groups=groups, how=Drawing(0), inject_z=False)
    assert len({str(row_of(noisy, i)) for i in range(8)}) > 2
    assert len({str(row_of(still, i)) for i in range(8)}) == 1
    seeds = sample_seeds(0, 8)
    assert torch.equal(draw_z(seeds, 3)[5:], draw_z(seeds[5:], 3))
    many = draw_z(sample_seeds(1, 4000), 2)
    assert many.mean().abs() < 0.05
    assert many.std().item() == pytest.approx(1, abs=0.03)


def test_bad_settings_are_refused(utt: Utt) -> None:
    condition = conditions(2)
    for settings, message in (
        ({"max_groups": 0}, "max_groups 0"),
        ({"context": -1}, "context -1"),
        ({"seed": [1]}, "1 seeds were given for 2"),
        ({"groups": torch.tensor([1, 0])}, "1 or more groups; got 0"),
        ({"groups": torch.tensor([1])}, "requested lengths were given for 2"),
        ({"groups": torch.tensor([1, 9]), "max_groups": 4}, "must be 1 to 4 groups; got 1 to 9"),
        ({"cfg_scale": 2.0}, "guidance needs"),
        ({"cfg_scale": [2.0] * 3, "null": null(2)}, "3 strengths"),
        ({"start": random_codes([1])}, "1 starts were given for 2"),
    ):
        with pytest.raises(UserError, match=message):
            generate(utt, condition, **settings)
    for name, value in (("temperature", -1.0), ("top_k", 0), ("top_p", 0.0)):
        with pytest.raises(UserError, match=name):
            Drawing(**{name: value})  # type: ignore[arg-type]
