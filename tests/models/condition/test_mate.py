"""MATE: subsets of modalities, padding and batch invariance, an independent reference, gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.conditions import Condition
from motionloom.models.condition.mate import Mate, MateConfig, drop_conditions
from motionloom.models.layers.transformer import sinusoid

SMALL = MateConfig(dim=16, layers=2, heads=4, ff=32)
WIDTHS = {"text": 5, "audio": 7}


@pytest.fixture
def mate() -> Mate:
    torch.manual_seed(0)
    return Mate(SMALL, WIDTHS, timed=["audio"]).double().eval()


def condition(width: int, size: int, lengths: list[int], rubbish: float = 0.0) -> Condition:
    generator = torch.Generator().manual_seed(width)
    rows = [torch.randn(n, width, generator=generator, dtype=torch.float64) for n in lengths]
    features = torch.full((len(lengths), size, width), rubbish, dtype=torch.float64)
    for row, values in enumerate(rows):
        features[row, : len(values)] = values
    return Condition(features, torch.arange(size) < torch.tensor(lengths)[:, None])


def reference(mate: Mate, conditions: dict[str, Tensor]) -> Tensor:
    """One row without padding, written out: [1 + S, E]."""
    first = mate.aggregate + sinusoid(1, 16).double()[0]
    rows = []
    for name, width in WIDTHS.items():
        x = conditions.get(name, torch.zeros(0, width, dtype=torch.float64))  # or strides of frames
        if len(x):
            first = first + mate.aggregate_of[name]
        places = sinusoid(100, 16).double()
        for i, vector in enumerate(x):
            rows.append(mate.project[name](vector) + mate.modality[name] + places[i + 1])
    x = torch.stack([first, *rows])
    for block in mate.stack.blocks:
        y = block.norm_attention(x)
        q, k, v = (t.view(len(x), 4, 4).transpose(0, 1) for t in block.attention.qkv(y).chunk(3, dim=-1))
        weights = (q @ k.transpose(1, 2) / 4**0.5).softmax(-1)
        x = x + block.attention.out((weights @ v).transpose(0, 1).reshape(len(x), 16))
        x = x + block.ff_out(functional.gelu(block.ff_in(block.norm_ff(x))))
    out: Tensor = mate.stack.norm(x)
    return out


def test_equals_the_formula_for_every_subset_in_one_padded_batch(mate: Mate) -> None:
    text = condition(5, 9, [4, 0, 9, 0], rubbish=float("nan"))
    audio = condition(7, 12, [0, 12, 3, 0], rubbish=1e9)
    out = mate({"audio": audio, "text": text})
    assert out.glob.shape == (4, 16)
    assert out.seq.shape == (4, 21, 16)
    assert torch.equal(out.mask, torch.cat([text.mask, audio.mask], dim=1))
    for row in range(4):
        alone = reference(
            mate, {"text": text.features[row][text.mask[row]], "audio": audio.features[row][audio.mask[row]]}
        )
        torch.testing.assert_close(out.glob[row], alone[0], rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(out.seq[row][out.mask[row]], alone[1:], rtol=1e-10, atol=1e-10)
    assert (out.seq[~out.mask] == 0).all()


def test_music_may_be_read_several_frames_a_position() -> None:
    torch.manual_seed(0)
    mate = Mate(SMALL.model_copy(update={"stride": 4}), WIDTHS, timed=["audio"]).double().eval()
    text, audio = condition(5, 9, [4, 0, 9]), condition(7, 14, [0, 14, 5], rubbish=1e9)
    out = mate({"audio": audio, "text": text})
    assert out.mask.sum(1).tolist() == [4, 4, 9 + 2]
    assert out.timed is not None
    assert torch.equal(out.timed, out.seq[:, 9:])
    for row, places in enumerate([0, 4, 2]):
        frames = torch.zeros(4 * places, 7, dtype=torch.float64)
        heard = audio.features[row][audio.mask[row]]
        frames[: len(heard)] = heard
        given = {"text": text.features[row][text.mask[row]], "audio": frames.reshape(places, 28)}
        alone = reference(mate, given)
        torch.testing.assert_close(out.glob[row], alone[0], rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(out.seq[row][out.mask[row]], alone[1:], rtol=1e-10, atol=1e-10)
    # Of frames one by one the timed part is the music's as well; of words alone there is none.
    plain = Mate(SMALL, WIDTHS, timed=["audio"]).double().eval()
    timed = plain({"audio": audio}).timed
    assert timed is not None
    assert timed.shape == (3, 14, 16)
    assert plain({"text": text}).timed is None
    assert mate.unconditional(2).timed is None


def test_a_modality_that_no_row_has_may_be_left_out(mate: Mate) -> None:
    text = condition(5, 6, [6, 2])
    out = mate({"text": text})
    full = mate({"text": text, "audio": condition(7, 4, [0, 0])})
    torch.testing.assert_close(out.glob, full.glob, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(out.seq, full.seq[:, :6], rtol=1e-10, atol=1e-10)


def test_dropped_rows_are_unconditional(mate: Mate) -> None:
    conditions = {"text": condition(5, 6, [6, 2, 3]), "audio": condition(7, 8, [8, 8, 0])}
    drop = torch.tensor([True, False, True])
    out = mate(drop_conditions(conditions, drop))
    plain, null = mate(conditions), mate.unconditional(2)
    assert null.seq.shape == (2, 0, 16)
    torch.testing.assert_close(out.glob[drop], null.glob, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(out.glob[1], plain.glob[1], rtol=1e-10, atol=1e-10)
    assert not out.mask[drop].any()
    assert not torch.allclose(plain.glob[0], null.glob[0], atol=1e-3)


def test_every_parameter_is_in_the_graph_whatever_is_given() -> None:
    torch.manual_seed(0)
    mate = Mate(SMALL, WIDTHS, timed=["audio"])
    text = condition(5, 6, [6, 0])
    out = mate({"text": Condition(text.features.float(), text.mask)})
    (out.glob.square().sum() + out.seq.square().sum()).backward()
    for name, parameter in mate.named_parameters():
        assert parameter.grad is not None, name
        if "audio" not in name:
            assert parameter.grad.abs().sum() > 0, name
        elif "project" in name:
            assert parameter.grad.abs().sum() == 0


def test_mistakes_are_named(mate: Mate) -> None:
    with pytest.raises(UserError, match=r"\['text', 'audio'\].*\['video'\]"):
        mate({"video": condition(5, 6, [6])})
    with pytest.raises(UserError, match=r"7 audio.* 5"):
        mate({"audio": condition(5, 6, [6])})
    with pytest.raises(ValueError, match="multiple of heads"):
        MateConfig(dim=10, heads=4)
