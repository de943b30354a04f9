"""TM2T in use: sentences about motions by beam search (section 3.3), and motion of text (section 3.2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import require_plain
from motionloom.datasets.base.records import PRESENT_ALL
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.models.gpt.rows import Drawing
from motionloom.models.gpt.tokens import interleave
from motionloom.pipeline.baselines.tm2t.network import END, START, Captioner, Reading, Vocabulary
from motionloom.pipeline.baselines.tm2t.seq2seq import Seq2Seq, draw_tokens
from motionloom.pipeline.contract.captioning import Sentence
from motionloom.pipeline.contract.generation import GenerationRequest
from motionloom.pipeline.inference.generators.base import OfTokens
from motionloom.pipeline.store.networks import TrainedTokenizer, device_of
from motionloom.pipeline.store.tokens import PresentTokens, present_table
from motionloom.pipeline.store.weights import Rows, Source


class Hypothesis(NamedTuple):
    """One sentence."""

    words: tuple[int, ...]
    """Their numbers, without End."""
    log_probability: float
    """Log-probability of the whole sentence and its end."""


@torch.no_grad()
def likeliest(net: Captioner, reading: Reading, count: int, beam: int) -> list[list[Hypothesis]]:
    """Return up to `count` sentences for each of B motions, likeliest first.

    Args:
        reading: Of the B motions, without a word yet.
        beam: Unfinished sentences that are kept, at least `count`; the wider, the surer that no likelier one
            is missed.
    """
    batch = len(reading.mask)
    beam = max(beam, count)
    device = reading.mask.device
    rows = torch.arange(batch, device=device)
    reading = reading.take(rows.repeat_interleave(beam))
    scores = torch.full((batch, beam), -torch.inf, device=device, dtype=torch.float64)
    scores[:, 0] = 0.0  # the beams of a motion begin as one
    last = torch.full((batch * beam,), START, device=device)
    said = torch.empty(batch, beam, 0, dtype=torch.int64, device=device)
    done: list[list[Hypothesis]] = [[] for _ in range(batch)]
    for step in range(net.config.max_words + 1):
        words = net.next(last, reading).double().view(batch, beam, -1)
        if step == 0:
            words[..., END] = -torch.inf  # a sentence is never empty
        if step == net.config.max_words:
            words[..., :END] = words[..., END + 1 :] = -torch.inf
        total = (scores[..., None] + words).flatten(1)
        # Twice the beam: as many as `beam` of the best may end here, and `beam` must go on.
        best, at = total.topk(min(2 * beam, total.shape[1]), dim=1)
        origin = at // words.shape[-1]
        word = at % words.shape[-1]
        for row in range(batch):
            for score, one, ended in zip(
                best[row].tolist(), origin[row].tolist(), (word[row] == END).tolist(), strict=True
            ):
                if ended and score > -torch.inf:
                    done[row].append(Hypothesis(tuple(said[row, one].tolist()), score))
            done[row] = sorted(done[row], key=lambda found: -found.log_probability)[:count]
        # Of those that go on, the first `beam`; at most `beam` of the 2 * beam end here.
        going = torch.where(word == END, -torch.inf, best)
        scores, kept = going.topk(beam, dim=1)
        # Words only make a sentence less likely, so the search ends once no other can overtake.
        pairs = zip(done, scores[:, 0].tolist(), strict=True)
        if all(len(found) == count and found[-1].log_probability >= left for found, left in pairs):
            break
        origin = origin.gather(1, kept)
        word = word.gather(1, kept)
        said = torch.cat([said.gather(1, origin[..., None].expand(-1, -1, step)), word[..., None]], dim=2)
        reading = reading.take((rows[:, None] * beam + origin).flatten())
        last = word.flatten()
    return done


BEAM = 4
"""Unfinished sentences that the search keeps, at least **[ours]**."""
_AT_ONCE = 32
"""Motions that are read together."""


@dataclass(frozen=True)
class TokenCaptioner:
    """TM2T's captioner: motion to tokens, tokens to words."""

    net: Captioner
    tokenizer: TrainedTokenizer
    vocabulary: Vocabulary

    @property
    def layout(self) -> MotionLayout:
        return self.tokenizer.layout

    @property
    def part(self) -> Part:
        return self.tokenizer.net.part

    @property
    def min_frames(self) -> int:
        return self.tokenizer.net.group_frames

    @property
    def max_frames(self) -> int:
        return self.net.max_groups * self.tokenizer.net.group_frames

    def reads(self, present: int) -> bool:
        return bool(present_table(self.tokenizer.net, self.layout).usable[present])

    def caption(
        self, motions: Sequence[NDArray[np.float32]], count: int, present: Sequence[int] | None = None
    ) -> list[list[Sentence]]:
        """As `MotionCaptioner` says; batches hold motions of about one length."""
        bits = [PRESENT_ALL] * len(motions) if present is None else list(present)
        order = np.argsort([len(motion) for motion in motions], kind="stable").tolist()
        out: dict[int, list[Sentence]] = {}
        for start in range(0, len(order), _AT_ONCE):
            rows = order[start : start + _AT_ONCE]
            made = self._batch([motions[row] for row in rows], count, [bits[row] for row in rows])
            out.update(zip(rows, made, strict=True))
        return [out[row] for row in range(len(motions))]

    @torch.no_grad()
    def _batch(
        self, motions: Sequence[NDArray[np.float32]], count: int, bits: Sequence[int]
    ) -> list[list[Sentence]]:
        net = self.net
        device = device_of(self.net)
        codes = self.tokenizer.encode([motion[: self.max_frames] for motion in motions], bits)
        closed = torch.tensor([len(motion) <= self.max_frames for motion in motions], device=device)
        tokens = interleave(codes.codes, net.pattern, ends=net.num_codes, groups=codes.groups, closed=closed)
        if not all(map(self.reads, bits)):
            raise UserError(
                "a motion lacks hands or a face, and this captioner's tokens say them and the body in one; "
                "give motions that have them, or a captioner on tokens of the body alone"
            )
        table = present_table(self.tokenizer.net, self.layout)
        present = PresentTokens(torch.tensor(bits), table.streams, table.columns)
        near = tokens._replace(tokens=tokens.tokens.cpu(), kinds=tokens.kinds.cpu())
        known = present.known(list(range(len(motions))), near, net.ends.cpu()).to(device)
        embedded = net.embedded(tokens.tokens, tokens.kinds, known)
        found = likeliest(net, net.begin(embedded, tokens.tokens >= 0), count, BEAM)
        return [
            [Sentence(self.vocabulary.decode(one.words), one.log_probability) for one in sentences]
            for sentences in found
        ]


@dataclass(frozen=True)
class Seq2SeqGenerator(OfTokens):
    """Tokens drawn word by word, then decoded."""

    net: Seq2Seq
    given: Mapping[str, Any]
    method = "seq2seq"
    settings = frozenset({"temperature", "top_k", "top_p"})

    @property
    def max_frames(self) -> int:
        return self.net.max_groups * self.unit_frames

    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        """Lengths that are no whole groups are made of one group more, and cut."""
        text = request.text("this model")
        device = device_of(self.net)
        sampling = request.sampling
        codes = draw_tokens(
            self.net,
            text.features.to(device),
            text.mask.to(device),
            self.whole_groups(request.frames),
            request.seeds,
            Drawing(sampling.temperature, sampling.top_k or None, sampling.top_p),
        )
        return self.decoded(codes, request.frames)


_LAYER = {
    "own": "slf_attn", "other": "enc_attn", "feed": "pos_ffn", "query": "w_qs", "key": "w_ks",
    "value": "w_vs", "out": "fc", "enter": "w_1", "leave": "w_2", "norm": "layer_norm",
}  # fmt: skip


def captioner_names(net: Captioner) -> dict[str, Source]:
    """Names of the network's parameters -> where they lie in TM2T's release.

    Its tokens are codes, Start, End and padding; its words Start, End, the unknown one, all others, padding.
    """
    out: dict[str, Source] = {}
    for name, _ in net.named_parameters():
        side, _, rest = name.partition(".")
        number, _, inner = rest.partition(".")
        if inner and side in ("encoder", "decoder"):
            theirs = [_LAYER.get(part, part) for part in inner.split(".")]
            out[name] = f"{side}.layer_stack.{number}.{'.'.join(theirs)}"
    [codes] = net.num_codes.values()
    tokens = "encoder.src_word_emb.weight"
    out["embeddings.0.weight"] = Rows(tokens, (*range(codes), codes + 1), codes + 3)
    out["start"] = Rows(tokens, (codes,), codes + 3)
    order = (net.words - 1, *range(net.words - 1))
    return out | {"word_table.weight": Rows("decoder.trg_word_emb.weight", order, net.words)}


def published_words(path: Path) -> tuple[str, ...]:
    """The words of published weights, in the order of their table; they stand in the file's metadata."""
    try:
        require_plain(path.expanduser())
        with safe_open(path.expanduser(), "pt") as file:
            said = (file.metadata() or {}).get("words", "")
    except (OSError, SafetensorError) as error:
        raise UserError(f"{path}: cannot be read ({' '.join(str(error).split())[:200]})") from None
    if not said:
        raise UserError(f"{path}: has no 'words' in its metadata; make it by docs/tm2t.py")
    return tuple(said.split("\n"))
