"""`TextCache`: every caption encoded once, looked up by content and read from a memory map.

| file             | content |
|------------------|---------|
| `keys.npy`       | uint8 [n, 32], sha256 of each caption's UTF-8, ascending; row i is the same below |
| `captions.jsonl` | the captions themselves, one JSON string a line |
| `sentence.npy`   | float32 [n, E], unit length |
| `offsets.npy`    | int64 [n + 1]: the tokens of caption i are rows `offsets[i] : offsets[i + 1]` |
| `tokens.npy`     | float16 [sum, E], without padding |
| `cache.json`     | encoder name, E, n; written last, so its presence means the rest is whole |

Captions are encoded in an order that depends on the set of captions alone, so building the same cache again
gives the same bytes. Adding captions encodes only the new ones.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from motionloom.datasets.schema import Config, UserError
from motionloom.datasets.shards.files import atomic_file, write_json, write_with
from motionloom.datasets.text.encoder import TextEncoder

BATCH = 64
_FILES = ("keys.npy", "captions.jsonl", "sentence.npy", "offsets.npy", "tokens.npy")


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
            self._keys = np.load(folder / "keys.npy", mmap_mode="r", allow_pickle=False)
            self._sentence = np.load(folder / "sentence.npy", mmap_mode="r", allow_pickle=False)
            self._offsets = np.load(folder / "offsets.npy", allow_pickle=False)
            self._tokens = np.load(folder / "tokens.npy", mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError) as error:
            raise UserError(
                f"{folder}: the text cache is damaged ({error}); run the text stage again"
            ) from None
        n, dim = info.count, info.dim
        rows = int(self._offsets[-1]) if self._offsets.shape == (n + 1,) else -1
        wanted = {"keys": (n, 32), "sentence": (n, dim), "offsets": (n + 1,), "tokens": (rows, dim)}
        for name, shape in wanted.items():
            if getattr(self, f"_{name}").shape != shape:
                raise UserError(f"{folder}/{name}.npy: not {list(shape)}; run the text stage again")
        if (np.diff(self._offsets) < 1).any() or self._offsets[0] != 0:
            raise UserError(f"{folder}/offsets.npy: damaged; run the text stage again")
        # The first eight bytes of the ascending keys as numbers: searched first, then the whole key is.
        self._heads = np.ascontiguousarray(self._keys[:, :8]).view(">u8").reshape(n).astype(np.uint64)

    @staticmethod
    def open(folder: Path | str) -> TextCache:
        """Open a finished cache."""
        folder = Path(folder)
        if not (folder / "cache.json").exists():
            raise UserError(f"{folder}: no finished text cache here; run the text stage")
        return TextCache(folder)

    @staticmethod
    def build(
        folder: Path | str, captions: Iterable[str], encoder: TextEncoder, progress: bool = True
    ) -> TextCache:
        """Encode the captions that are not there yet; another encoder's cache is replaced."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        wanted = {key_of(text): text for text in captions}
        if not wanted:
            raise UserError("no captions to encode: the dataset has none")
        old = _reusable(folder, encoder)
        known = old.keys() if old else set()
        new = sorted(wanted.keys() - known)
        if old is not None and not new:
            return old
        texts = {**(old.captions_by_key() if old else {}), **wanted}
        fresh = _encode({key: wanted[key] for key in new}, encoder, progress)
        _write(folder, texts, fresh, old, encoder)
        return TextCache.open(folder)

    def __len__(self) -> int:
        return len(self._keys)

    def sentence(self, captions: Sequence[str]) -> NDArray[np.float32]:
        """Unit-length sentence embeddings, [n, E]."""
        return np.asarray(self._sentence[self._rows(captions)], dtype=np.float32)

    def tokens(self, captions: Sequence[str]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Token embeddings [n, S, E], zero padded to the longest, and the mask [n, S] of real tokens."""
        rows = self._rows(captions)
        begin, length = self._offsets[rows], self._offsets[rows + 1] - self._offsets[rows]
        out = np.zeros((len(rows), int(length.max(initial=0)), self.dim), dtype=np.float32)
        for i in range(len(rows)):
            out[i, : length[i]] = self._tokens[begin[i] : begin[i] + length[i]]
        return out, np.arange(out.shape[1])[None] < length[:, None]

    def keys(self) -> set[bytes]:
        """sha256 of every caption here."""
        return {row.tobytes() for row in self._keys}

    def captions_by_key(self) -> dict[bytes, str]:
        """Every caption here."""
        lines = (self.folder / "captions.jsonl").read_text(encoding="utf-8").splitlines()
        return {key_of(text): text for text in map(json.loads, lines)}

    def row(self, key: bytes) -> int | None:
        """Row of a caption's key, or None."""
        head = np.uint64(int.from_bytes(key[:8], "big"))
        first = int(np.searchsorted(self._heads, head, side="left"))
        while first < len(self._heads) and self._heads[first] == head:
            if self._keys[first].tobytes() == key:
                return first
            first += 1
        return None

    def entry(self, row: int) -> tuple[NDArray[np.float32], NDArray[np.float16]]:
        """(sentence [E], tokens [S, E]) of one row."""
        return self._sentence[row], self._tokens[self._offsets[row] : self._offsets[row + 1]]

    def _rows(self, captions: Sequence[str]) -> NDArray[np.int64]:
        rows = np.empty(len(captions), dtype=np.int64)
        for i, text in enumerate(captions):
            row = self.row(key_of(text))
            if row is None:
                raise UserError(
                    f"caption '{text[:80]}' is not in the text cache {self.folder}; run the text stage again"
                )
            rows[i] = row
        return rows

    def __getstate__(self) -> Path:
        return self.folder

    def __setstate__(self, folder: Path) -> None:
        TextCache.__init__(self, folder)


def key_of(caption: str) -> bytes:
    """sha256 of a caption's UTF-8 bytes, exactly as written."""
    return hashlib.sha256(caption.encode()).digest()


def _reusable(folder: Path, encoder: TextEncoder) -> TextCache | None:
    """The cache in `folder` when it is whole and of the same encoder."""
    try:
        found = TextCache.open(folder)
    except UserError:
        return None
    return found if (found.encoder, found.dim) == (encoder.name, encoder.dim) else None


def _encode(
    captions: dict[bytes, str], encoder: TextEncoder, progress: bool
) -> dict[bytes, tuple[NDArray[np.float32], NDArray[np.float16]]]:
    """Key -> (sentence [E], tokens [S, E]).

    Sorted by length first: little padding, and an order that is a function of the set alone.
    """
    order = sorted(captions.items(), key=lambda pair: (len(pair[1]), pair[0]))
    out = {}
    for start in track(range(0, len(order), BATCH), "encoding captions", disable=not progress):
        part = order[start : start + BATCH]
        encoded = encoder.encode([text for _, text in part])
        for i, (key, _) in enumerate(part):
            out[key] = (encoded.sentence[i], encoded.tokens[i][encoded.mask[i]].astype(np.float16))
    return out


def _write(
    folder: Path,
    texts: dict[bytes, str],
    fresh: dict[bytes, tuple[NDArray[np.float32], NDArray[np.float16]]],
    old: TextCache | None,
    encoder: TextEncoder,
) -> None:
    """Merge and write every file; `cache.json` goes first and comes back last."""
    keys = sorted(texts)

    def entry(key: bytes) -> tuple[NDArray[np.float32], NDArray[np.float16]]:
        if key in fresh:
            return fresh[key]
        assert old is not None
        row = old.row(key)
        assert row is not None
        return old.entry(row)

    entries = [entry(key) for key in keys]
    offsets = np.concatenate([[0], np.cumsum([len(tokens) for _, tokens in entries])]).astype(np.int64)
    (folder / "cache.json").unlink(missing_ok=True)
    arrays: dict[str, NDArray] = {
        "keys.npy": np.frombuffer(b"".join(keys), dtype=np.uint8).reshape(len(keys), 32),
        "sentence.npy": np.stack([sentence for sentence, _ in entries]).astype(np.float32),
        "offsets.npy": offsets,
        "tokens.npy": np.concatenate([tokens for _, tokens in entries]),
    }
    for name, values in arrays.items():
        write_with(folder / name, partial(_save_array, values))
    with atomic_file(folder / "captions.jsonl") as file:
        for key in keys:
            file.write(json.dumps(texts[key], ensure_ascii=False).encode() + b"\n")
    info = CacheInfo(encoder=encoder.name, dim=encoder.dim, count=len(keys))
    write_json(folder / "cache.json", info.dump())


def _save_array(values: NDArray, file: BinaryIO) -> None:
    np.save(file, values, allow_pickle=False)
