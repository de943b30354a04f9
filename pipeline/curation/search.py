"""Search a data set by text or by example: TMA's embeddings of all clips, in one file.

Embeddings have length 1 and are stored in half precision; clips are ranked by their cosine with a query. The
file beside the shards says which clips and which weights it was made of, and is made again for others. The
encoder that the TMA was trained with reads the text; nothing is fetched. How well the model finds the set's
clips by their own captions is measured with them: below `LEAST_PRECISION` it answers no words.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import atomic_file, sha256_of, sha256_of_json
from motionloom.datasets.base.json_doors import read_plain
from motionloom.datasets.base.progress import Meter
from motionloom.datasets.base.records import HANDS, PRESENT_ALL, Fault
from motionloom.datasets.motion.canonical import canonicalize, require_rate, resample
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.npz import MAX_BYTES, NpzFile
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.shards.reader import load_manifest
from motionloom.datasets.shards.tar import npy_from_bytes
from motionloom.pipeline.contract.lookup import finished_stages, open_exported
from motionloom.pipeline.contract.stage import ALIGNMENT, StageCache
from motionloom.pipeline.curation.suspects import Place, Splits, floored_joints, open_splits
from motionloom.pipeline.inference.clip_file import RecordedClip, read_clip, require_clip
from motionloom.pipeline.inference.shipped_models import model_folder, no_such_model
from motionloom.pipeline.launch.hardware import choose_device
from motionloom.pipeline.store.evaluator import embed_motions
from motionloom.pipeline.store.networks import LoadedTma
from motionloom.pipeline.store.run_folder import BUNDLE_FILE
from motionloom.pipeline.store.weights import MODEL_FILES

INDEX_FILE = "search.npz"
_VERSION = 3
_BATCH = 32
"""Clips that are read and embedded at a time: more are no faster on a processor, and take its memory."""
MISFIT = 0.5
"""Share of other captions that fit a motion better than its own from which its own are suspect: above a half,
the captions of a random clip would do as well."""
_OTHERS = 500
"""Captions, evenly spread, that a motion's own are compared with."""
LEAST_PRECISION = 0.3
"""R-precision from which a model reads a set. By chance it is 3 of 32, .09; `synthetic` has .97 on synthetic
clips and .23 on Bandai-Namco's, where it finds byes for turns."""
_ASKED = 200
"""Captions, evenly spread, of which the R-precision is the mean."""
_WRISTS = [Skeleton.named("smpl22").index(f"{side}_wrist") for side in ("left", "right")]

Vectors = NDArray[np.float32]


class Hit(NamedTuple):
    """A clip that was found."""

    place: Place
    id: str
    score: float
    """Cosine with the query."""


def unit(vectors: Vectors) -> Vectors:
    """Vectors [..., Z] scaled to length 1."""
    return np.asarray(
        vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12), np.float32
    )


def alignment_model(name: Path | str, device: str = "auto") -> tuple[LoadedTma, str]:
    """The TMA of a run, of an export or of a model of the package, and the checksum of its weights."""
    folder = model_folder(name)
    if (folder / BUNDLE_FILE).is_file():
        stages = [s for maker in open_exported(folder) for s in (maker, *maker.upstream())]
    elif folder.is_dir():
        stages = sorted(finished_stages(folder).values(), key=lambda stage: stage.name != "tma")
    else:
        raise UserError(no_such_model(name))
    stage = next((stage for stage in stages if stage.gives(ALIGNMENT)), None)
    if stage is None:
        raise UserError(
            f"{folder}: has no TMA, which embeds words and motions alike; choose another --model, such as "
            f"synthetic"
        )
    tma: LoadedTma = StageCache(choose_device(device)).get(stage)
    return tma, sha256_of(stage.folder / MODEL_FILES[0])


@dataclass(frozen=True)
class Search:
    """A data set and the embeddings of its clips."""

    splits: Splits
    """All clips, also excluded ones, which are never returned."""
    tma: LoadedTma
    vectors: Vectors
    """Embeddings [n, Z] of length 1, in the order of `places`."""
    places: tuple[Place, ...]
    precision: float
    """R-precision by the set's own captions (`_precision`); NaN for a set without captions."""
    excluded: frozenset[str] = field(default_factory=frozenset)

    @staticmethod
    def open(root: Path, model: Path | str, *, device: str = "auto", progress: bool = False) -> Search:
        """The embeddings beside the shards; made first where there are none of these clips by this model."""
        splits = open_splits(root, every=True)
        (tma, weights) = alignment_model(model, device)
        manifest = load_manifest(root)
        clips = manifest.model_copy(update={"excluded": {}}).dump()
        made_from = sha256_of_json([_VERSION, clips, weights])
        places = tuple(Place(split, clip) for split, part in splits.items() for clip in range(len(part)))
        stored = _stored(root / INDEX_FILE, made_from, (len(places), tma.net.config.latent))
        if stored is None:
            half = np.concatenate(list(_embedded(splits, places, tma, progress)))
            vectors = half.astype(np.float32)  # the same numbers as when the file is read
            stored = vectors, _precision(splits, places, tma, vectors)
            with atomic_file(root / INDEX_FILE) as file:
                key = np.frombuffer(made_from.encode(), np.uint8)
                precision = np.array(stored[1])
                np.savez(file, allow_pickle=False, made_from=key, vectors=half, precision=precision)
        return Search(splits, tma, stored[0], places, stored[1], frozenset(manifest.excluded))

    @cached_property
    def ids(self) -> list[str]:
        return [self.splits[place.split].ids[place.clip] for place in self.places]

    def words(self, text: str) -> Vectors:
        """The embedding [Z] of a text; `UserError` where the model does not know the set."""
        if not text.strip():
            raise UserError("search: no words; say what the person does")
        self._require_known()
        found: Vectors = _embed_texts(self.tma, [text])[0]
        return found

    def _require_known(self) -> None:
        if self.precision < LEAST_PRECISION:
            raise UserError(
                f"the model cannot tell the clips of this set apart by words: of 32, the clip of a caption "
                f"is among the first three for {self.precision:.0%} of its own captions (by chance 9%); give "
                f"--model a run that was trained on such clips, or look for clips --like one"
            )

    def clip(self, clip_id: str) -> Vectors:
        """The embedding [Z] of a clip of the set, by its id."""
        if clip_id not in self.ids:
            raise UserError(f"no clip '{clip_id}' in this data set; a search prints its ids")
        return np.asarray(self.vectors[self.ids.index(clip_id)])

    def motion(self, joints: NDArray[np.floating], fps: float) -> Vectors:
        """The embedding [Z] of joints [T, 22 or 52, 3] in metres, Y up."""
        features, present = features_for(self.tma, joints, fps)
        return np.asarray(embed_motions(self.tma, [features], [present])[0])

    def motion_file(self, path: Path) -> Vectors:
        """The embedding [Z] of a clip file (`read_clip`) or an .npy of joints or columns [T, D]."""
        if path.suffix.lower() != ".npy":
            clip = read_clip(path)
        else:
            layout = next(iter(self.splits.values())).layout
            values = npy_from_bytes(read_plain(path, MAX_BYTES), str(path)).astype(np.float64)
            joints = joints_of(values, layout) if values.ndim == 2 else values
            if joints.ndim != 3 or joints.shape[1] not in (BODY_JOINTS, 52) or joints.shape[2] != 3:
                raise UserError(f"{path}: {list(joints.shape)}, wanted joints [T, 22 or 52, 3]")
            clip = require_clip(RecordedClip(str(path), joints, layout.fps))
        return self.motion(clip.joints, clip.fps)

    def best(self, query: Vectors, count: int = 12, without: str = "") -> list[Hit]:
        """The clips nearest to an embedding [Z], the best first, except the one with the id `without`."""
        scores = self.vectors @ unit(query)
        hits = list[Hit]()
        # Enough candidates that excluded clips, were they the nearest, leave `count` others.
        some = min(len(scores), count + 1 + len(self.excluded))
        near = np.argpartition(-scores, some - 1)[:some] if some else np.zeros(0, int)
        for row in near[np.argsort(-scores[near], kind="stable")].tolist():
            if self.ids[row] not in self.excluded and self.ids[row] != without:
                hits.append(Hit(self.places[row], self.ids[row], float(scores[row])))
        return hits[:count]

    def misfits(self) -> Iterator[tuple[Place, Fault]]:
        """Yield the clips whose own captions fit them worse than most of the other captions do.

        `UserError` where the model does not know the set.
        """
        self._require_known()
        texts = [[c.text for c in self.splits[place.split].texts(place.clip)] for place in self.places]
        different = sorted({text for own in texts for text in own})
        if len(different) < 2:
            return
        row = {text: k for k, text in enumerate(different)}
        captions = _embed_texts(self.tma, different)
        spread = _spread(len(different), _OTHERS)
        others = captions[spread]
        for at, (place, own) in enumerate(zip(self.places, texts, strict=True)):
            if own:
                mine = captions[[row[text] for text in own]] @ self.vectors[at]
                theirs = others @ self.vectors[at]
                share = float((theirs > mine.max()).mean())
                if share > MISFIT:
                    nearest = own[int(mine.argmax())]
                    best = different[int(spread[int(theirs.argmax())])]
                    text = f"'{nearest}' fits worse than {share:.0%} of all captions, such as '{best}'"
                    yield place, Fault(kind="caption disagrees", text=text, weight=float(share / MISFIT))


def _embed_texts(tma: LoadedTma, texts: Sequence[str]) -> Vectors:
    """Embeddings [n, Z] of length 1."""
    return unit(np.asarray(tma.embed_captions(list(texts), tma.given["text"])))


def _spread(count: int, most: int) -> NDArray[np.int_]:
    """At most so many rows of `count`, evenly spread: enough to estimate a share, and fast on large sets."""
    return np.unique(np.linspace(0, count - 1, most).round().astype(int))


def _precision(splits: Splits, places: Sequence[Place], tma: LoadedTma, vectors: Vectors) -> float:
    """How often a clip is among the three that fit its caption best, of it and 31 clips with other captions.

    Not drawn but expected: with a share b of all others that fit better, none, one or two of 31 do so by the
    binomial distribution.
    """
    clips = defaultdict[str, list[int]](list)
    for at, place in enumerate(places):
        for caption in splits[place.split].texts(place.clip):
            clips[caption.text].append(at)
    texts = sorted(clips)
    asked = [texts[row] for row in _spread(len(texts), _ASKED)] if texts else []
    found = list[float]()
    for text, query in zip(asked, _embed_texts(tma, asked) if asked else (), strict=True):
        scores = vectors @ query
        others = np.delete(scores, clips[text])
        if len(others):
            better = (others > scores[clips[text], None]).mean(axis=1)
            first = (1 - better) ** 29 * ((1 - better) ** 2 + 31 * better * (1 - better) + 465 * better**2)
            found.append(float(first.mean()))
    return float(np.mean(found)) if found else float("nan")


def features_for(tma: LoadedTma, joints: NDArray[np.floating], fps: float) -> tuple[Vectors, int]:
    """Return what a TMA reads of joints [T, 22 or 52, 3] of any frame rate, and the parts present in it."""
    layout = tma.layout
    present = PRESENT_ALL
    require_rate(len(joints), fps, layout.fps)
    if layout.num_joints > joints.shape[1]:
        present &= ~HANDS  # fingers stay at the wrists, and are not looked at
        fingers = (layout.num_joints - BODY_JOINTS) // 2
        joints = np.concatenate([joints, np.repeat(joints[:, _WRISTS], fingers, axis=1)], axis=1)
    joints = canonicalize(resample(joints[:, : layout.num_joints], fps, layout.fps))
    return encode(joints, layout.without_face()), present


def _embedded(
    splits: Splits, places: Sequence[Place], tma: LoadedTma, progress: bool
) -> Iterator[NDArray[np.float16]]:
    with Meter("embedding clips", len(places), shown=progress) as meter:
        for start in range(0, len(places), _BATCH):
            motions = []
            present = []
            for split, clip in places[start : start + _BATCH]:
                dataset = splits[split]
                if dataset.layout == tma.layout:
                    motion = dataset.motion(clip)[:, dataset.layout.part(tma.part)]
                    held = int(dataset.present[clip])
                else:
                    motion, held = features_for(tma, floored_joints(dataset, clip), dataset.layout.fps)
                motions.append(motion)
                present.append(held)
            yield unit(np.asarray(embed_motions(tma, motions, present))).astype(np.float16)
            meter.advance(len(motions))


def _stored(path: Path, made_from: str, shape: tuple[int, int]) -> tuple[Vectors, float] | None:
    """The stored embeddings of these clips and weights, and their precision; None for others, a damaged file,
    or no file.
    """
    try:
        with NpzFile(path) as stored:
            if stored.array("made_from", limit=4096).tobytes() != made_from.encode():
                return None
            vectors = stored.array("vectors", limit=2 * shape[0] * shape[1] + 4096)
            precision = stored.array("precision", limit=4096)
    except UserError:
        return None
    if vectors.shape != shape or vectors.dtype != np.float16 or precision.shape != ():
        return None
    return vectors.astype(np.float32), float(precision)
