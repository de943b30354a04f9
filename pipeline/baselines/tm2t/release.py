"""TM2T's captioner under the names of its release, as `docs/tm2t.py` makes it a file of safetensors."""

from __future__ import annotations

from pathlib import Path

from safetensors import SafetensorError, safe_open

from motionloom.datasets.schema import UserError
from motionloom.pipeline.baselines.tm2t.network import Captioner
from motionloom.pipeline.store.weights import Rows, Source

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
        with safe_open(path.expanduser(), "pt") as file:
            said = (file.metadata() or {}).get("words", "")
    except (OSError, SafetensorError) as error:
        raise UserError(f"{path}: cannot be read ({' '.join(str(error).split())[:200]})") from None
    if not said:
        raise UserError(f"{path}: has no 'words' in its metadata; make it by docs/tm2t.py")
    return tuple(said.split("\n"))
