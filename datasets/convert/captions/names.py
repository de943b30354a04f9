"""Names of motion files: the words of a label, and the subject.

HDM05 names its cuts `HDM_bd_kickLFront1Reps_003_120`: actor, label, number, frame rate. CMU's trials are
`01_02`: subject and trial. AMASS puts subjects in folders.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from motionloom.datasets.base.files import sha256_of_json
from motionloom.datasets.convert.common.splits import TRAIN_SHARE, VAL_SHARE
from motionloom.datasets.schema import Split

_HDM05 = re.compile(r"(HDM_[a-z]+)_(.+?)(?:_\d+)*")
_TRIAL = re.compile(r"(\d+)_\d+(?:_\w+)?")
_WORD = re.compile(r"[LR](?=[a-z]{3,}[Ss]tart|start|Hand|Foot|Leg|Arm)|[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+")
_SIDES = {"l": "left", "r": "right"}
_AMASS = re.compile(r"_(?:poses|stageii)$")


def label_words(path: str) -> str:
    """The words of a file's name: `HDM_bd_kickLFront1Reps_003_120` is `kick left front once`.

    Camel case is taken apart, L and R are sides, HDM05's repetitions are counted, other numbers left out.
    """
    stem = _stem(path)
    found = _HDM05.fullmatch(stem)
    words = [word.lower() for word in _WORD.findall(found[2] if found else stem)]
    words = words if found else [word for word in words if not word.isdigit()]
    label: list[str] = []
    while words:
        word = words.pop(0)
        if word.isdigit() and words[:1] == ["reps"]:
            words.pop(0)
            label.append("once" if word == "1" else f"{word} times")
        elif word == "1" and words and words[0].endswith("s"):
            label += [word, words.pop(0)[:-1]]
        elif word in _SIDES and "start" in words[:2]:
            at = words.index("start")
            label[-1:] = [f"{one}," for one in label[-1:]]
            label += ["starting with the", _SIDES[word], *words[:at]]
            words = words[at + 1 :]
        else:
            label.append(_SIDES.get(word, word))
    return " ".join(label).strip()


def subject_of(path: str) -> str:
    """The subject of a file: by the naming of HDM05 or CMU, else the folder, else the name's first word."""
    stem = _stem(path)
    for pattern in (_HDM05, _TRIAL):
        if found := pattern.fullmatch(stem):
            return found[1]
    folder = path.rpartition("/")[0]
    return folder or re.split(r"[_\-. ]", stem)[0]


def subject_splits(paths: Sequence[str]) -> tuple[dict[str, Split], list[str]]:
    """Split of every file, all of a subject in one: about 80/5/15 of the files, in the order of a hash.

    Of three subjects and more, each split has one. The note says how many subjects are where.
    """
    groups: dict[str, list[str]] = {}
    for path in paths:
        groups.setdefault(subject_of(path), []).append(path)
    splits: dict[str, Split] = {}
    # Subjects are taken in the order of a hash until each split has its share of the *files*.
    done, subjects = 0, dict.fromkeys(("train", "val", "test"), 0)
    # Those with many clips come last: a test set of one of them would be too large.
    order = sorted(groups, key=lambda name: (len(groups[name]) > len(paths) / 4, sha256_of_json(name)))
    for number, name in enumerate(order):
        share = (done + len(groups[name]) / 2) / len(paths)
        split: Split = "train"
        if len(order) > 1 and (number == 0 or share < 1 - TRAIN_SHARE - VAL_SHARE):
            split = "test"
        elif len(order) > 2 and (not subjects["val"] or share < 1 - TRAIN_SHARE):
            split = "val"
        subjects[split] += 1
        done += len(groups[name])
        splits |= dict.fromkeys(groups[name], split)
    counts = ", ".join(f"{count} {split}" for split, count in subjects.items())
    return splits, [f"split by subject: {counts}"]


def _stem(path: str) -> str:
    name = path.rsplit("/", 1)[-1]
    return _AMASS.sub("", name.rpartition(".")[0] or name)
