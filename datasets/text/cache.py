"""`TextCache`: every caption encoded once, looked up by content and read from a memory map.

| file             | content |
|------------------|---------|
| `keys.npy`       | uint8 [n, 32], sha256 of each caption's UTF-8, ascending; row i is the same below |
| `captions.jsonl` | the captions themselves, one JSON string a line |
| `sentence.npy`   | float32 [n, E], of unit length but for CLIP's |
| `offsets.npy`    | int64 [n + 1]: the tokens of caption i are rows `offsets[i] : offsets[i + 1]` |
| `tokens.npy`     | float16 [sum, E], without padding |
| `cache.json`     | encoder name, E, n; written last, so its presence means the rest is whole |
| `similarity/`    | another encoder's sentence embeddings, where these are not to say what is alike |

`datasets/text/build.py` makes these files; `similarity/` is a cache too, of one token a caption.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import parse_json, read_plain
from motionloom.datasets.motion.npz import map_npy

if TYPE_CHECKING:
    from torch import Tensor

SIMILARITY = "similarity"
_KEY = np.dtype("S32")
"""A sha256; numpy compares all of its bytes, those after a zero too."""


class CacheInfo(Config):
    """`cache.json`."""

    encoder: str
    dim: int
    count: int


class TextCache:
    """Encoded captions of one encoder. Arrays stay on disk; cheap to pickle into loader workers."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        info = CacheInfo.load_json(folder / "cache.json")
        self.encoder = info.encoder
        self.dim = info.dim
        try:
            self._keys = map_npy(folder / "keys.npy")
            self._sentence = map_npy(folder / "sentence.npy")
            self._tokens = map_npy(folder / "tokens.npy")
            self._offsets = offsets = map_npy(folder / "offsets.npy")
        except UserError as error:
            raise UserError(
                f"{folder}: the text cache is damaged ({error}); run the text stage again"
            ) from None
        n = info.count
        dim = info.dim
        rows = int(offsets[-1]) if offsets.shape == (n + 1,) and offsets.dtype == np.int64 else -1
        wanted = {"keys": (n, 32), "sentence": (n, dim), "offsets": (n + 1,), "tokens": (rows, dim)}
        kinds = (np.uint8, np.float32, np.int64, np.float16)
        for (name, shape), kind in zip(wanted.items(), kinds, strict=True):
            found = getattr(self, f"_{name}")
            if found.shape != shape or found.dtype != kind:
                raise UserError(f"{folder}/{name}.npy: not {list(shape)}; run the text stage again")
        if n < 0 or (np.diff(offsets) < 1).any() or offsets[0] != 0:
            raise UserError(f"{folder}/offsets.npy: damaged; run the text stage again")
        other = folder / SIMILARITY
        self._other = TextCache(other) if (other / "cache.json").exists() else None

    @staticmethod
    def open(folder: Path | str) -> TextCache:
        folder = Path(folder)
        if not (folder / "cache.json").exists():
            raise UserError(f"{folder}: no finished text cache here; run the text stage")
        return TextCache(folder)

    def __len__(self) -> int:
        return len(self._keys)

    def sentence(self, captions: Sequence[str]) -> NDArray[np.float32]:
        """Sentence embeddings [n, E], as the encoder gives them."""
        return np.asarray(self._sentence[self._rows(captions)], dtype=np.float32)

    def similarity(self, captions: Sequence[str]) -> NDArray[np.float32]:
        """Unit-length embeddings whose cosines say which captions mean the same, [n, S]."""
        return _unit((self._other or self).sentence(captions))

    def places(self, captions: Sequence[str]) -> dict[str, NDArray[np.int64]]:
        """The rows [n] of captions by which `sentences` and `similarities` find theirs."""
        rows = self._rows(captions)
        return {"sentence": rows, "similarity": rows if self._other is None else self._other._rows(captions)}

    def sentences(self, rows: NDArray[np.int64]) -> CaptionVectors:
        """`sentence` of the captions of these rows, by number."""
        return CaptionVectors(self._sentence, rows)

    def similarities(self, rows: NDArray[np.int64]) -> CaptionVectors:
        """`similarity` of the captions of these rows, by number."""
        return CaptionVectors((self._other or self)._sentence, rows, unit=True)

    def tokens(self, captions: Sequence[str]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Token embeddings [n, S, E], zero padded to the longest, and the mask [n, S] of real tokens."""
        import torch  # only batches pay for the import

        rows = self._rows(captions)
        begin = self._offsets[rows]
        length = self._offsets[rows + 1] - self._offsets[rows]
        position = np.arange(length.max(initial=0))[None]
        mask = position < length[:, None]
        # Padding repeats the last token, then becomes 0: one gather is cheaper than filling by the mask.
        found = np.asarray(self._tokens)[begin[:, None] + np.minimum(position, length[:, None] - 1)]
        out = torch.from_numpy(found).float().numpy()  # four times as fast as numpy's
        out[~mask] = 0.0
        return out, mask

    def captions_by_key(self) -> dict[bytes, str]:
        path = self.folder / "captions.jsonl"
        try:
            lines = read_plain(path, 2**32).splitlines()
        except OSError as error:
            raise UserError(f"{path}: cannot be read ({error.strerror}); run the text stage again") from None
        texts = [parse_json(line, f"{path}:{number}") for number, line in enumerate(lines, start=1)]
        return {key_of(text): text for text in texts if isinstance(text, str)}

    def lengths(self) -> NDArray[np.int64]:
        return np.asarray(np.diff(self._offsets))

    def entry(self, row: int) -> tuple[NDArray[np.float32], NDArray[np.float16]]:
        """(sentence [E], tokens [S, E]) of one row."""
        return self._sentence[row], self._tokens[self._offsets[row] : self._offsets[row + 1]]

    def find(self, captions: Sequence[str]) -> NDArray[np.int64]:
        """Rows [n] of captions, -1 where one is not here."""
        wanted = np.frombuffer(b"".join(map(key_of, captions)), dtype=_KEY)
        known = np.ascontiguousarray(self._keys).view(_KEY)[:, 0]
        rows = np.searchsorted(known, wanted).clip(max=len(known) - 1)
        return np.where(known[rows] == wanted, rows, -1)

    def _rows(self, captions: Sequence[str]) -> NDArray[np.int64]:
        rows = self.find(captions)
        if len(rows) and rows.min() < 0:
            raise UserError(
                f"caption '{captions[int(rows.argmin())][:80]}' is not in the text cache {self.folder}; run "
                f"the text stage again"
            )
        return rows


def _unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Vectors [n, E] of length 1; those that have it stay as they are, to the bit."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(abs(length - 1) < 1e-5, vectors, vectors / length.clip(min=1e-12))


@dataclass(frozen=True)
class CaptionVectors:
    """Vectors of m captions, read from a file where they are asked for: a process holds none."""

    values: NDArray[np.float32]
    rows: NDArray[np.int64] | None = None
    """The captions' rows in the file, [m]; None if it has theirs alone."""
    unit: bool = False
    """Scaled to length 1."""

    def __getitem__(self, numbers: NDArray[np.int64]) -> Tensor:
        """Vectors float32 [n, E] of captions by their numbers."""
        import torch  # only batches pay for the import

        rows = numbers if self.rows is None else self.rows[numbers]
        found = np.asarray(self.values[rows], dtype=np.float32)
        return torch.from_numpy(_unit(found) if self.unit else found)


@lru_cache(2**16)  # a training asks for the same captions three times a batch, epoch after epoch
def key_of(caption: str) -> bytes:
    """sha256 of a caption's UTF-8 bytes, exactly as written."""
    return hashlib.sha256(caption.encode()).digest()
