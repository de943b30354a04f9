"""GPT training on clips without hands: their hand tokens are neither predicted, read, nor decoded."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.gpt.losses import cross_entropy
from motionloom.models.gpt.module import GptModule
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.models.gpt.tokens import interleave
from motionloom.models.tma.network import Tma, TmaConfig
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.models.tokenizer.build import build_tokenizer
from motionloom.models.tokenizer.config import H2VQConfig, SeparateConfig
from motionloom.models.training.stage_module import OptimConfig

LAYOUT = MotionLayout.named("wholebody313")
HAND = torch.from_numpy(LAYOUT.part("hand"))
NET = GptConfig(layers=2, dim=32, heads=4, ff=64, block_size=30, dropout=0.0, attention_dropout=0.0)
GROUPS = torch.tensor([5, 2, 3, 4])
LACKS = torch.tensor([False, True, False, True])


def made(kind: type[H2VQConfig] | type[SeparateConfig] = H2VQConfig) -> tuple[GptModule, Tokenizer]:
    torch.manual_seed(0)
    tokenizer = build_tokenizer(kind(width=16, depth=1, code_dim=8, num_codes=9), LAYOUT)
    for book in tokenizer.codebooks().values():
        book.codebook.normal_()
    tma = Tma(TmaConfig(latent=16, ff=32, layers=1, heads=2), 313, 10)
    net = InterleavedGPT(NET, tokenizer.streams, tokenizer.pattern, text_dim=16)
    module = GptModule(net, OptimConfig(), seed=0, max_steps=1, tokenizer=tokenizer, tma=tma)
    return module.eval(), tokenizer


def batch_of(tokenizer: Tokenizer, *, garbage: bool = False, lacks: Tensor = LACKS) -> dict[str, Any]:
    """Four clips, of which some lack hands; `garbage` stands in their hand codes."""
    generator = torch.Generator().manual_seed(1)
    codes = {
        s.name: torch.randint(0, 9, (4, 5 * s.per_group), generator=generator) for s in tokenizer.streams
    }
    if garbage:
        codes["hand"] = torch.where(lacks[:, None], (codes["hand"] + 4) % 9, codes["hand"])
    ends = {s.name: s.num_codes for s in tokenizer.streams}
    sequence = interleave(codes, tokenizer.pattern, ends=ends, groups=GROUPS)
    present = torch.ones(4, 313, dtype=torch.bool)
    present[lacks.nonzero(), HAND] = False
    text = torch.randn(4, 16, generator=generator)
    known = ~(lacks[:, None] & (sequence.kinds == 1)) | (sequence.tokens == 9)
    return {**sequence._asdict(), "text": text, "known": known, "present": present}


def losses(module: GptModule, batch: dict[str, Any]) -> tuple[dict[str, Tensor], list[Tensor | None]]:
    module.zero_grad()
    values = module.losses(batch)
    values["loss"].backward()
    return {k: v.detach() for k, v in values.items()}, [p.grad for p in module.net.parameters()]


def test_hand_codes_of_clips_without_hands_change_nothing() -> None:
    module, tokenizer = made()
    one, other = (losses(module, batch_of(tokenizer, garbage=garbage)) for garbage in (False, True))
    torch.testing.assert_close(one, other, rtol=0, atol=0)
    told = batch_of(tokenizer, garbage=True)
    del told["known"], told["present"]
    assert (losses(module, told)[0]["ce"] - one[0]["ce"]).abs() > 1e-4, "else they would"


def test_all_recorded_is_the_same_as_not_told() -> None:
    module, tokenizer = made()
    batch = batch_of(tokenizer, lacks=torch.zeros(4, dtype=torch.bool))
    told = losses(module, batch)
    del batch["known"], batch["present"]
    torch.testing.assert_close(told, losses(module, batch), rtol=0, atol=0)


def test_cross_entropy_leaves_out_what_is_not_known() -> None:
    module, tokenizer = made()
    batch = batch_of(tokenizer)
    tokens, kinds, known = batch["tokens"], batch["kinds"], batch["known"]
    logits = module.net(tokens, kinds, batch["text"], known=known)
    total, count = 0.0, 0
    hits, hands = 0, 0
    for row, groups in enumerate(GROUPS.tolist()):
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
    reader = tma.read

    def watched(x: torch.Tensor, present: torch.Tensor | None = None) -> torch.Tensor:
        read.append(reader(x, present))
        return read[-1]

    monkeypatch.setattr(tma, "read", watched)
    batch = batch_of(tokenizer)
    module.losses(batch)
    logits = module.net(batch["tokens"], batch["kinds"], batch["text"], known=batch["known"])
    steps = logits[:, :15].view(4, 5, 3, -1)[..., :9]
    best = steps.argmax(-1)
    codes = {"body": best[:, :, :2].flatten(1), "hand": best[:, :, 2]}
    wanted = tokenizer.decode(codes, 4 * GROUPS, batch["present"]).masked_fill(
        ~batch["present"][:, None], 0.0
    )
    for row, groups in enumerate(GROUPS.tolist()):
        frames = 4 * groups
        torch.testing.assert_close(read[0][row, :frames], wanted[row, :frames], rtol=1e-4, atol=1e-5)
        assert (read[0][row][:, HAND] == 0).all() == LACKS[row]
