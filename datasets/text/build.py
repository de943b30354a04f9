"""Making a text cache in parts, by any number of processes.

Captions that are not in the cache yet are divided by the first bits of their keys into parts of about 512.
A part is encoded on one thread, in an order that depends on its captions alone: the bytes of the finished
cache do not depend on how many processes made it, nor on how many machines. A part's file is named by what it
holds, so that whoever finishes the cache takes what others have made, or what a killed process had made.

Parts are ranges of ascending keys, so merging them, with what the cache held before, is one pass that
streams to disk. The old files stay in place until all new ones are written.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import atomic_file, remove_temporaries, write_json
from motionloom.datasets.base.pool import Workers
from motionloom.datasets.text.cache import SIMILARITY, CacheInfo, TextCache, key_of
from motionloom.datasets.text.encoder import EncodedText, TextEncoder, load_text_encoder

PART = 512
"""Number of captions in a part, about."""

PARTS_A_WORKER = 4
"""Fewer are encoded here before another process has loaded the encoder."""

BATCH = 64
"""Captions encoded together: of one part, and of similar length."""


ALL = (0, 1)
"""The share of a process that makes all parts."""


def build_text_cache(
    folder: Path | str,
    captions: Iterable[str],
    encoder_name: str,
    workers: int = 1,
    progress: bool = True,
    device: str = "cpu",
    similarity: str | None = None,
    share: tuple[int, int] = ALL,
) -> TextCache | None:
    """Encode the captions that `folder` does not hold yet, in `workers` processes of one thread each.

    `encoder_name` as for `load_text_encoder`; another encoder's cache is replaced. The same captions give
    the same bytes for any number of workers. On a GPU (`device`) one process encodes them all.

    `similarity` names the encoder whose sentence embeddings say which captions mean the same; None is
    `encoder_name`.

    Process r of n encodes the parts of its `share` (r, n) alone, and returns nothing: another call, without a
    share, finishes the cache of all parts.
    """
    folder = Path(folder)
    captions = set(captions)
    workers = workers if device == "cpu" else 1
    encoder = load_text_encoder(encoder_name, device=device)
    make = partial(_build, captions=captions, progress=progress, workers=workers, share=share)
    make(folder, encoder=encoder, spec=encoder_name, load=load_text_encoder)
    if similarity not in (None, encoder_name):
        other = load_sentences(similarity, device=device)
        make(folder / SIMILARITY, encoder=other, spec=similarity, load=load_sentences)
    elif share == ALL:
        shutil.rmtree(folder / SIMILARITY, ignore_errors=True)
    return TextCache.open(folder) if share == ALL else None


class SentencesOnly:
    """A text encoder whose tokens are not wanted: each caption is one token, its sentence embedding."""

    def __init__(self, encoder: TextEncoder) -> None:
        self._encoder = encoder
        self.name = f"{encoder.name}:sentences"
        self.dim = encoder.dim

    def encode(self, captions: Sequence[str]) -> EncodedText:
        sentence = self._encoder.encode(captions).sentence
        return EncodedText(sentence, sentence[:, None], np.ones((len(sentence), 1), dtype=bool))


def load_sentences(spec: str, *, device: str = "cpu") -> SentencesOnly:
    """`load_text_encoder` for sentence embeddings alone."""
    return SentencesOnly(load_text_encoder(spec, device=device))


Load = Callable[[str], TextEncoder]


@dataclass(frozen=True)
class _Part:
    """Captions of a range of keys, ascending by key, and the file that will hold them."""

    path: Path
    captions: tuple[str, ...]


def build_with_encoder(
    folder: Path, captions: Iterable[str], encoder: TextEncoder, progress: bool = True
) -> TextCache:
    """The same in this process, with an encoder that is loaded already."""
    _build(folder, captions, encoder, progress)
    return TextCache.open(folder)


def _build(
    folder: Path,
    captions: Iterable[str],
    encoder: TextEncoder,
    progress: bool,
    spec: str = "",
    workers: int = 1,
    load: Load = load_text_encoder,
    share: tuple[int, int] = ALL,
) -> None:
    """Encode this process's share of the parts, and finish the cache where that is all; further `workers` get
    their encoder by `load(spec)`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    wanted = {key_of(text): text for text in captions}
    if not wanted:
        raise UserError("no captions to encode: the dataset has none")
    old = _reusable(folder, encoder)
    rows = old.find(list(wanted.values())).tolist() if old else [-1] * len(wanted)
    new = sorted(key for key, row in zip(wanted, rows, strict=True) if row < 0)
    place = folder / "parts"
    parts = _parts(new, wanted, place, encoder.name)
    missing = [part for part in parts[slice(share[0], None, share[1])] if not part.path.is_file()]
    workers = min(workers, len(missing) // PARTS_A_WORKER)
    encode: Callable[[_Part], None] = partial(_encode_part, encoder=encoder)
    if workers > 1:
        encode = partial(_encode_elsewhere, load, spec, encoder.name)
    with Workers(workers) as pool:
        done = pool.run(encode, missing)
        for _ in track(done, "encoding captions", total=len(missing), disable=not (progress and missing)):
            pass
    if share != ALL:
        return
    if new or old is None:
        remove_temporaries(folder)
        texts = {**(old.captions_by_key() if old else {}), **wanted}
        _merge(folder, texts, parts, old, encoder)
    shutil.rmtree(place, ignore_errors=True)


def _encode_elsewhere(load: Load, spec: str, expected: str, part: _Part) -> None:
    """Encode a part in another process: the encoder is loaded there, once."""
    encoder = _loaded(load, spec)
    if encoder.name != expected:
        raise UserError(f"text encoder '{spec}' changed while captions were encoded; run again")
    _encode_part(part, encoder)


@lru_cache(maxsize=1)
def _loaded(load: Load, spec: str) -> TextEncoder:
    return load(spec)


def _reusable(folder: Path, encoder: TextEncoder) -> TextCache | None:
    """The cache in `folder` when it is whole and of the same encoder."""
    try:
        found = TextCache.open(folder)
    except UserError:
        return None
    return found if (found.encoder, found.dim) == (encoder.name, encoder.dim) else None


def _parts(keys: Sequence[bytes], texts: dict[bytes, str], place: Path, encoder: str) -> list[_Part]:
    """Parts of ascending keys, by their first bits: as many bits as make parts of at most PART on average."""
    bits = max(0, (len(keys) - 1) // PART).bit_length()
    groups: dict[int, list[bytes]] = {}
    for key in keys:
        groups.setdefault(int.from_bytes(key[:4], "big") >> (32 - bits), []).append(key)
    return [
        _Part(
            place / f"{hashlib.sha256(b''.join([encoder.encode(), *members])).hexdigest()}.npz",
            tuple(texts[key] for key in members),
        )
        for _, members in sorted(groups.items())
    ]


def _encode_part(part: _Part, encoder: TextEncoder) -> None:
    """Write `sentence` [n, E], `lengths` [n] and `tokens` [sum, E]; encoded by length to pad little."""
    order = sorted(range(len(part.captions)), key=lambda i: (len(part.captions[i]), i))
    sentence = np.empty((len(order), encoder.dim), dtype=np.float32)
    tokens: list[NDArray[np.float16]] = [np.empty((0, encoder.dim), dtype=np.float16)] * len(order)
    for start in range(0, len(order), BATCH):
        rows = order[start : start + BATCH]
        encoded = encoder.encode([part.captions[i] for i in rows])
        sentence[rows] = encoded.sentence
        for i, states, mask in zip(rows, encoded.tokens, encoded.mask, strict=True):
            tokens[i] = states[mask].astype(np.float16)
    lengths = np.array([len(rows) for rows in tokens], dtype=np.int64)
    with atomic_file(part.path) as file:
        np.savez(file, allow_pickle=False, sentence=sentence, lengths=lengths, tokens=np.concatenate(tokens))


def _merge(
    folder: Path, texts: dict[bytes, str], parts: Sequence[_Part], old: TextCache | None, encoder: TextEncoder
) -> None:
    """Stream everything into the five files; they replace the old ones together, `cache.json` last."""
    # Parts are ranges of ascending keys, so one pass over all keys takes each entry in its turn.
    keys = sorted(texts)
    # Row in the old cache, or -1: the next of the parts.
    rows = old.find([texts[key] for key in keys]).tolist() if old else [-1] * len(keys)
    known = old.lengths() if old else np.empty(0, dtype=np.int64)
    measured = (int(n) for part in parts for n in _load(part, "lengths"))
    lengths = [next(measured) if row < 0 else int(known[row]) for row in rows]
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    with ExitStack() as stack:
        files = {
            name: stack.enter_context(atomic_file(folder / name))
            for name in ("keys.npy", "captions.jsonl", "sentence.npy", "offsets.npy", "tokens.npy")
        }
        _header(files["sentence.npy"], (len(keys), encoder.dim), np.float32)
        _header(files["tokens.npy"], (int(offsets[-1]), encoder.dim), np.float16)
        encoded = _encoded(parts)
        for key, row in zip(keys, rows, strict=True):
            sentence, tokens = next(encoded) if row < 0 or old is None else old.entry(row)
            files["sentence.npy"].write(sentence.tobytes())
            files["tokens.npy"].write(tokens.tobytes())
            files["captions.jsonl"].write(json.dumps(texts[key], ensure_ascii=False).encode() + b"\n")
        packed = np.frombuffer(b"".join(keys), dtype=np.uint8).reshape(len(keys), 32)
        np.save(files["keys.npy"], packed, allow_pickle=False)
        np.save(files["offsets.npy"], offsets, allow_pickle=False)
        # Without its description a half-replaced cache is none, and is made again.
        (folder / "cache.json").unlink(missing_ok=True)
    info = CacheInfo(encoder=encoder.name, dim=encoder.dim, count=len(keys))
    write_json(folder / "cache.json", info.dump())


def _encoded(parts: Sequence[_Part]) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float16]]]:
    """(sentence [E], tokens [S, E]) of every caption of every part, holding one part at a time."""
    for part in parts:
        tokens = _load(part, "tokens")
        ends = np.cumsum(_load(part, "lengths"))
        for sentence, end, length in zip(
            _load(part, "sentence"), ends, np.diff(ends, prepend=0), strict=True
        ):
            yield sentence, tokens[end - length : end]


def _load(part: _Part, name: str) -> NDArray:
    with np.load(part.path, allow_pickle=False) as arrays:
        return np.asarray(arrays[name])


def _header(file: BinaryIO, shape: tuple[int, ...], dtype: type) -> None:
    """Write what `np.save` does before the values."""
    description = {"descr": np.dtype(dtype).str, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, description)
