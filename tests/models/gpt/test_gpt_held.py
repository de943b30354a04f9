"""GPT training on clips without hands: their hand tokens are neither predicted, read, nor decoded."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from toy_gpt import HAND, aligned_gpt, sequences

from motionloom.models.gpt.losses import cross_entropy
from motionloom.models.gpt.module import GptModule
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.models.tokenizer.body_hand import H2VQConfig, SeparateConfig

GROUPS = [5, 2, 3, 4]
LACKS = torch.tensor([False, True, False, True])


def made(kind: type[H2VQConfig | SeparateConfig] = H2VQConfig) -> tuple[GptModule, Tokenizer]:
    module, tokenizer, _ = aligned_gpt(kind)
    return module.eval(), tokenizer


def batch_of(module: GptModule, *, garbage: bool = False, lacks: Tensor = LACKS) -> dict[str, Any]:
    """Four clips, of which some lack hands; `garbage` stands in their hand codes."""
    sequence, text = sequences(GROUPS, module.net)
    tokens, absent = sequence.tokens, lacks[:, None] & (sequence.kinds == 1) & (sequence.tokens < 9)
    if garbage:
        tokens = torch.where(absent, (tokens + 4) % 9, tokens)
    present = torch.ones(4, 313, dtype=torch.bool)
    present[lacks.nonzero(), HAND] = False
    given = {**sequence._asdict(), "tokens": tokens, "text": text}
    return {**given, "known": ~absent, "present": present}


def losses(module: GptModule, batch: dict[str, Any]) -> tuple[dict[str, Tensor], list[Tensor | None]]:
    module.zero_grad()
    values = module.losses(batch)
    values["loss"].backward()
    return {k: v.detach() for k, v in values.items()}, [p.grad for p in module.net.parameters()]


def test_hand_codes_of_clips_without_hands_change_nothing() -> None:
    module, _ = made()
    one, other = (losses(module, batch_of(module, garbage=garbage)) for garbage in (False, True))
    torch.testing.assert_close(one, other, rtol=0, atol=0)
    told = batch_of(module, garbage=True)
    del told["known"], told["present"]
    assert (losses(module, told)[0]["ce"] - one[0]["ce"]).abs() > 1e-4, "else they would"
    batch = batch_of(module, lacks=torch.zeros(4, dtype=torch.bool))
    told = losses(module, batch)
    del batch["known"], batch["present"]
    torch.testing.assert_close(told, losses(module, batch), rtol=0, atol=0)


def test_cross_entropy_leaves_out_what_is_not_known() -> None:
    module, _ = made()
    batch = batch_of(module)
    tokens, kinds, known = batch["tokens"], batch["kinds"], batch["known"]
    logits = module.net(tokens, kinds, batch["text"], known=known)
    total, count = 0.0, 0
    hits, hands = 0, 0
    for row, groups in enumerate(GROUPS):
        for position in range(3 * groups + 1):  # the hand's End after the body's is certain
            hand = position % 3 == 2
            if hand and LACKS[row]:
                continue
            total -= logits[row, position].log_softmax(-1)[tokens[row, position]].item()
            count += 1
            if hand:
                hands += 1
                hits += int(logits[row, position].argmax() == tokens[row, position])
    assert cross_entropy(logits, tokens, known).item() == pytest.approx(total / count, rel=1e-5)
    assert module.losses(batch)["accuracy_hand"].item() == pytest.approx(hits / hands)


@pytest.mark.parametrize("kind", [H2VQConfig, SeparateConfig])
def test_tma_reads_such_clips_as_in_its_own_training(
    kind: type[H2VQConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The body as the tokenizer decodes it for a clip without hands, and the mean in the hands."""
    module, tokenizer = made(kind)
    assert module.tma is not None
    tma, read = module.tma.module, []
    reader = tma.coordinates

    def watched(x: torch.Tensor, present: torch.Tensor | None = None) -> torch.Tensor:
        read.append(reader(x, present))
        return read[-1]

    monkeypatch.setattr(tma, "coordinates", watched)
    batch = batch_of(module)
    module.losses(batch)
    logits = module.net(batch["tokens"], batch["kinds"], batch["text"], known=batch["known"])
    steps = logits[:, :15].view(4, 5, 3, -1)[..., :9]
    best = steps.argmax(-1)
    codes = {"body": best[:, :, :2].flatten(1), "hand": best[:, :, 2]}
    wanted = tokenizer.decode(codes, 4 * torch.tensor(GROUPS), batch["present"]).masked_fill(
        ~batch["present"][:, None], 0.0
    )
    for row, groups in enumerate(GROUPS):
        frames = 4 * groups
        torch.testing.assert_close(read[0][row, :frames], wanted[row, :frames], rtol=1e-4, atol=1e-5)
        assert (read[0][row][:, HAND] == 0).all() == LACKS[row]
