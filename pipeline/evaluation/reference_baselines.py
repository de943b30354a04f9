"""Reference baselines that need no model: motions retrieved from the training set, and the mean pose.

A model that only memorises answers with the training clip nearest to a motion, the training dance to the
nearest music, or the training motion of the nearest caption. One has learnt more than its training clips only
where it does better than these.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.records import HANDS
from motionloom.datasets.loading.crops import caption_spans
from motionloom.datasets.motion.features.joints import joints_of, local_joints_of
from motionloom.datasets.motion.layout import BODY_JOINTS, MotionLayout
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.datasets.text.cache import TextCache
from motionloom.datasets.text.encoder import load_text_encoder
from motionloom.pipeline.evaluation.dances import DanceClip
from motionloom.pipeline.evaluation.truth import Truth, has_caption, truth_in, truth_of

Joints = NDArray[np.float64]

_TOGETHER = 64
"""Motions that are compared with the training clips at once."""
KEY_FRAMES = 16
"""Frames of each clip that are compared **[ours]**."""


def local_joints(features: NDArray[np.float32], layout: MotionLayout) -> NDArray[np.float64]:
    """Joints [T, N, 3] relative to the root and in its heading: the pose without its path.

    Layouts that store such positions are read as they are, so that errors of the path play no part.
    """
    if not layout.has("positions"):
        return local_joints_of(joints_of(features, layout), layout.fps)
    positions = features[..., layout.slice("positions")].astype(np.float64)
    positions = positions.reshape(*positions.shape[:-1], layout.num_joints - 1, 3)
    height = features[..., layout.slice("root_height")].astype(np.float64)
    positions[..., 1] -= height
    return np.concatenate([np.zeros_like(positions[..., :1, :]), positions], axis=-2)


class NearestClip:
    """Finds the training clip whose poses, stretched to the same length, are nearest to a motion's.

    Hands are compared where both clips have them; for a motion with hands only clips with hands are
    candidates, where the training set has any.
    """

    def __init__(self, train: ClipDataset) -> None:
        self.train = train
        self.columns = train.layout.part("bodyhand")
        # Half as wide as what is computed with: of 65 thousand clips 640 MB.
        self.keys = [np.empty((len(train), len(part)), np.float32) for part in self._key_of(0)]
        for clip in range(len(train)):
            for table, part in zip(self.keys, self._key_of(clip), strict=True):
                table[clip] = part
        self.norms = [np.einsum("ij,ij->i", part, part) for part in self.keys]
        self.with_hands = (train.present & HANDS) > 0

    def _key_of(self, clip: int) -> list[NDArray[np.float64]]:
        """`_key` of a training clip."""
        return self._key(np.asarray(self.train.motion(clip))[:, self.columns])

    def _key(self, features: NDArray[np.float32]) -> list[NDArray[np.float64]]:
        """Positions of the body's joints and of the hands', each flat."""
        layout = self.train.layout
        if layout.has("positions"):
            key = stretch(features[:, layout.slice("positions")], KEY_FRAMES)
        else:
            key = stretch(local_joints(features, layout)[:, 1:].reshape(len(features), -1), KEY_FRAMES)
        return [part.ravel() for part in np.split(key, [3 * (BODY_JOINTS - 1)], axis=1)]

    def find(self, motions: Sequence[NDArray[np.float32]], present: Sequence[int]) -> list[int]:
        """Numbers of those clips; `present` says what the features `motions` [T, D] hold."""
        keys = [self._key(features) for features in motions]
        # Squared distances up to the motion's own |key|^2, which the order does not depend on.
        body, hands = (
            norms - 2 * np.stack(wanted).astype(np.float32) @ part.T
            for norms, part, wanted in zip(self.norms, self.keys, zip(*keys, strict=True), strict=True)
        )
        found = []
        for row, key in enumerate(keys):
            with_hands = bool(present[row] & HANDS and self.with_hands.any())
            distance = np.where(self.with_hands, body[row] + hands[row], np.inf) if with_hands else body[row]
            # What float32 cannot tell apart is compared anew. Its sums of 2,448 products, each at most
            # |key|^2 + |other key|^2, are off by less than 1e-5 of these.
            size = sum(float(np.square(part).sum()) for part in key) + sum(part.max() for part in self.norms)
            near = np.flatnonzero(distance <= distance.min() + 1e-5 * size).tolist()
            if len(near) > 1:
                parts = slice(None) if with_hands else slice(1)
                wanted = np.concatenate(key[parts])
                away = [np.square(np.concatenate(self._key_of(clip)[parts]) - wanted).sum() for clip in near]
                near = near[int(np.argmin(away)) :]
            found.append(near[0])
        return found

    def motions(self, truths: Sequence[Truth]) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Yield (pose, joints), [T, N, 3] each, of that clip for each of `truths`, stretched to its T frames.

        Features are stretched and their velocities scaled with time; where the layout has none, the joints
        are stretched, since angles cannot be averaged.
        """
        for first in range(0, len(truths), _TOGETHER):
            some = truths[first : first + _TOGETHER]
            found = self.find([t.features for t in some], [t.present for t in some])
            for clip, truth in zip(found, some, strict=True):
                yield self._stretched(clip, len(truth.features))

    def _stretched(self, clip: int, frames: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        own = np.asarray(self.train.motion(clip))[:, self.columns]
        layout = self.train.layout
        if not layout.has("positions"):
            joints = joints_of(own, layout)
            path = stretch(joints.reshape(len(joints), -1), frames).reshape(-1, *joints.shape[1:])
            return local_joints_of(path, layout.fps), path
        out = stretch(own, frames)
        # A clip that is played faster moves faster: its velocities grow as its time shrinks.
        for field in ("root_yaw_velocity", "root_xz_velocity", "velocities"):
            out[:, layout.slice(field)] *= len(own) / frames
        near = out.astype(np.float32)
        return local_joints(near, layout), joints_of(near, layout)


def stretch(values: NDArray[np.floating], frames: int) -> NDArray[np.float64]:
    """Linear resampling of [T, D] to `frames` rows, first and last kept."""
    at = np.linspace(0, len(values) - 1, frames)
    low = np.floor(at).astype(int)
    high = np.minimum(low + 1, len(values) - 1)
    weight = (at - low)[:, None]
    wide = values.astype(np.float64)
    return np.asarray(wide[low] * (1 - weight) + wide[high] * weight)


def mean_poses(pool: Sequence[Joints], fps: float, lengths: Iterable[int]) -> list[Joints]:
    """The mean pose of training motions [T, N, 3], held for each of the `lengths` in frames."""
    poses = []
    heights = []
    for joints in pool:
        poses.append(local_joints_of(joints, fps).mean(0))
        heights.append(joints[:, 0, 1].mean())
    pose = np.mean(poses, axis=0)
    pose[:, 1] += np.mean(heights)
    return [np.tile(pose, (frames, 1, 1)) for frames in lengths]


def random_dances(
    pool: Sequence[DanceClip], clips: Sequence[DanceClip], rng: np.random.Generator
) -> list[Joints]:
    """For each clip a random stretch of a random training dance, as long as the clip where one is."""
    out = []
    for clip in clips:
        frames = len(clip.joints)
        long = [other for other in pool if len(other.joints) >= frames] or list(pool)
        joints = long[int(rng.integers(len(long)))].joints
        start = int(rng.integers(max(0, len(joints) - frames) + 1))
        out.append(joints[start : start + frames])
    return out


def nearest_dances(
    train: ClipDataset, pool: Sequence[DanceClip], dataset: ClipDataset, clips: Sequence[DanceClip]
) -> list[Joints] | None:
    """For each clip the training dance to the most similar music, cut to the clip's length.

    Music is compared by the mean over time of the stored audio features, each in units of its standard
    deviation among the training dances **[ours]**. Dances shorter than the clip are candidates only where
    there is none as long. None where the data store no audio features.
    """
    pool_music = _music_means(train, pool)
    wanted = _music_means(dataset, clips)
    if pool_music is None or wanted is None:
        return None
    spread = pool_music.std(0)
    spread = np.where(spread > 1e-8, spread, np.inf)  # a constant feature tells no two songs apart
    lengths = np.array([len(other.joints) for other in pool])
    out = []
    for clip, music in zip(clips, wanted, strict=True):
        away = (((pool_music - music) / spread) ** 2).sum(1)
        if (lengths >= len(clip.joints)).any():
            away[lengths < len(clip.joints)] = np.inf
        out.append(pool[int(away.argmin())].joints[: len(clip.joints)])
    return out


def _music_means(dataset: ClipDataset, clips: Sequence[DanceClip]) -> NDArray[np.float64] | None:
    """Mean audio features [n, 438] of clips; None where one has none."""
    rows = []
    for clip in clips:
        features = dataset.array(clip.index, "audio.npy")
        if features is None or not len(features):
            return None
        rows.append(features.mean(0, dtype=np.float64))
    return np.stack(rows)


_ENCODER = "minilm"
_BATCH = 256
_MIN_FRAMES = 16
"""Shortest stretch that a caption is about, as in `truth_of`."""


def by_nearest_caption(
    train: ClipDataset, truths: Sequence[Truth], caches: Iterable[TextCache] = ()
) -> list[Truth]:
    """For each clip the training motion whose caption has the nearest sentence embedding (MiniLM, cosine); of
    equal captions the first. An empty list where the training clips have no captions.

    Captions that one of the `caches` holds by that encoder are not embedded again.
    """
    spans = [
        (index, span)
        for index in np.flatnonzero(has_caption(train)).tolist()
        for span in caption_spans(train.texts(index), train.layout.fps, int(train.frames[index]), _MIN_FRAMES)
    ]
    first = {span.text: number for number, (_, span) in reversed(list(enumerate(spans)))}
    if not first:
        return []
    numbers = list(first.values())
    nearest = nearest_texts(list(first), [t.caption for t in truths], caches)
    return [truth_in(train, *spans[numbers[index]]) for index in nearest]


def nearest_texts(known: Sequence[str], wanted: Sequence[str], caches: Iterable[TextCache] = ()) -> list[int]:
    """For each wanted text the number of the known one with the nearest sentence embedding, by cosine."""
    words = sorted({*known, *wanted})
    encoder = load_text_encoder(_ENCODER)
    sentence = np.empty((len(words), encoder.dim), dtype=np.float32)
    missing = np.arange(len(words))
    for cache in caches:
        if cache.encoder == encoder.name and len(missing):
            here = cache.find([words[row] for row in missing.tolist()]) >= 0
            sentence[missing[here]] = cache.sentence([words[row] for row in missing[here].tolist()])
            missing = missing[~here]
    for rows in np.split(missing, range(_BATCH, len(missing), _BATCH)):
        if len(rows):
            sentence[rows] = encoder.encode([words[row] for row in rows.tolist()]).sentence
    place = {text: row for row, text in enumerate(words)}
    among = sentence[[place[text] for text in known]]
    queries = sentence[[place[text] for text in wanted]]
    out: list[int] = []
    for first in range(0, len(queries), _BATCH):
        out += (queries[first : first + _BATCH] @ among.T).argmax(1).tolist()
    return out


def by_nearest_labels(train: ClipDataset, truths: Sequence[Truth]) -> list[Truth]:
    """For each clip the training clip whose truth agrees most; empty unless every clip has a truth."""
    usable = np.flatnonzero(has_caption(train)).tolist()
    records = [train.meta(index).truth for index in usable]
    if not usable or not all(records) or not all(t.truth for t in truths):
        return []
    nearest = most_similar([record or {} for record in records], [t.truth or {} for t in truths])
    return [truth_of(train, usable[index]) for index in nearest]


def most_similar(known: Sequence[Mapping[str, object]], wanted: Sequence[Mapping[str, object]]) -> list[int]:
    """For each wanted truth the number of the first known one that agrees in most of its attributes."""
    names = sorted({name for one in wanted for name in one})
    columns = {name: np.array([str(record.get(name)) for record in known]) for name in names}
    out = []
    for one in wanted:
        attributes = [(name, str(value)) for name, value in one.items() if value is not None]
        out.append(int(np.sum([columns[name] == value for name, value in attributes], axis=0).argmax()))
    return out
