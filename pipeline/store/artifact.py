"""`artifact.json`: what a finished stage made, from what, with which config; written last of all.

It holds no times and no machine facts: an undisturbed run and one that was killed and resumed write the same
bytes.

Files are compared with the sha256 written there, once as long as they do not change: `.compared.json` of the
run notes what has been compared, and whoever opens a file next only looks whether it is as it was (same size,
times and number on the disk).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

from pydantic import Field, JsonValue, field_validator

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import State, sha256_of, state_of
from motionloom.datasets.base.json_doors import parse_json, read_plain
from motionloom.datasets.base.licences import UNKNOWN, strictest
from motionloom.datasets.base.lock import LOCK_FILE, file_lock
from motionloom.pipeline.store.files import write_json
from motionloom.pipeline.store.run_folder import STAGE_NAME, identity_of, in_export, owner_of, stage_folder

FILE_NAME = "artifact.json"

# What no result depends on: a stage's own notes, and settings that a later run may change.
_PRIVATE = {
    *("checkpoints", "logs", "flight", "samples", "started.json", "timing.json", "reader.json"),
    FILE_NAME,
}


class OutputFile(Config):
    """One file of an artifact."""

    bytes: int
    sha256: str


class InputStage(Config):
    """The stage that fed a role, and its fingerprint then; of one outside the run its identity."""

    stage: str = Field(pattern=STAGE_NAME)
    fingerprint: str
    folder: str | None = Field(None, exclude_if=lambda folder: folder is None)
    """Folder of a stage outside the run, seen from the run's. None: a stage of the run itself."""

    def place(self, stage: Path) -> Path:
        """Its folder; `stage` is that of the stage which it fed."""
        if self.folder is None:
            return stage.parent / self.stage
        return (owner_of(stage) / self.folder).resolve()

    def now(self, stage: Path) -> str | None:
        """The value of `fingerprint` for the stage that is there now; None if there is none."""
        place = self.place(stage)
        return fingerprint_now(place) if self.folder is None else identity_of(place)

    def say(self, stage: Path) -> str:
        """Its name, for people; with the place of one outside the run."""
        owner = "" if self.folder is None else f" of {owner_of(self.place(stage))}"
        return f"'{self.stage}'{owner}"


class Change(Config):
    """A setting that changed while a training went on."""

    step: int
    """The last step with the old value."""
    key: str
    old: JsonValue
    new: JsonValue


class Terms(Config):
    """Licences of all data that something was made from, and the sentences that they ask for."""

    licences: tuple[str, ...] = ()
    credits: tuple[str, ...] = ()

    @property
    def licence(self) -> str:
        """Return the licence of a model: the strictest of its data."""
        return strictest(self.licences)

    @classmethod
    def union(cls, parts: Iterable[Terms]) -> Terms:
        """Return the terms of mixed data, or of all stages that something was made from."""
        parts = list(parts)
        licences = sorted({licence for part in parts for licence in part.licences})
        sentences = dict.fromkeys(sentence for part in parts for sentence in part.credits)
        return cls(licences=tuple(licences), credits=tuple(sentences))

    @classmethod
    def of(cls, stages: Iterable[Path]) -> Terms:
        """Return the terms of finished stages, by their folders; unknown where a stage does not say."""
        made = [Artifact.find(stage) for stage in stages]
        unknown = cls(licences=(UNKNOWN,))
        return cls.union(unknown if one is None or one.terms is None else one.terms for one in made)


class Artifact(Config):
    """The record of a finished stage."""

    stage: str
    kind: str
    version: int
    fingerprint: str
    seed: int
    config: dict[str, object]
    code: dict[str, str] = Field(default_factory=dict, exclude_if=lambda code: not code)
    """sha256 of the code from other packages than motionloom that made it, by module."""
    changed: tuple[Change, ...] = Field((), exclude_if=lambda changed: not changed)
    """Settings of a training that were others until a step; `config` holds the last ones."""
    step: int | None = Field(None, exclude_if=lambda step: step is None)
    """Step of weights that were taken from a training before its end."""
    trained_by: str | None = Field(None, exclude_if=lambda name: name is None)
    """What trained it where that was not motionloom, with its steps."""
    inputs: dict[str, InputStage]
    terms: Terms | None = Field(None, exclude_if=lambda terms: terms is None)
    """Licences and credits of its own data and of all stages above it."""
    outputs: dict[str, OutputFile] = Field(default_factory=dict)

    @field_validator("outputs")
    @classmethod
    def _in_its_folder(cls, outputs: dict[str, OutputFile]) -> dict[str, OutputFile]:
        for name in outputs:
            if Path(name).is_absolute() or ".." in Path(name).parts or not Path(name).name:
                raise ValueError(f"names {name!r}, which is no file of its folder")
        return outputs

    @staticmethod
    def find(folder: Path) -> Artifact | None:
        path = folder / FILE_NAME
        return Artifact.load_json(path) if path.is_file() else None

    def missing(self, folder: Path) -> str | None:
        """First output that is gone or has another size."""
        for name, info in self.outputs.items():
            path = folder / name
            if not path.is_file() or path.stat().st_size != info.bytes:
                return name
        return None

    def finish(self, folder: Path) -> Artifact:
        outputs = {}
        for path in sorted(p for p in folder.rglob("*") if p.is_file()):
            name = path.relative_to(folder).as_posix()
            if name.split("/")[0] not in _PRIVATE and not path.name.startswith("."):
                outputs[name] = OutputFile(bytes=path.stat().st_size, sha256=sha256_of(path))
        done = self.model_copy(update={"outputs": outputs})
        write_json(folder / FILE_NAME, done.dump())
        return done


Changed = tuple[Path, InputStage]
"""The folder of a stage, and one of its inputs that is another now than the stage was made from."""


def changed_above(folder: Path, visited: dict[Path, Changed | None]) -> Changed | None:
    """The first change above a stage, or of its own inputs; `found` keeps what was looked at.

    Goes up to the first stage of all, into other runs too; an export is whole in itself. What is gone without
    a trace cannot be compared and is let through.
    """
    key = folder.resolve()
    if key not in visited:
        visited[key] = None  # a damaged folder may name itself
        artifact = None if in_export(folder) else Artifact.find(folder)
        sources = [] if artifact is None else list(artifact.inputs.values())
        # Its own inputs first: the nearest change explains most.
        own_ones = ((folder, one) for one in sources if one.now(folder) not in (None, one.fingerprint))
        above = (changed_above(source.place(folder), visited) for source in sources)
        visited[key] = next(own_ones, None) or next(filter(None, above), None)
    return visited[key]


def require_consistent(run: Path, stages: Iterable[str]) -> None:
    """Refuse stages of a run that were made from something else than what their inputs hold now."""
    for name in stages:
        if changed := changed_above(stage_folder(run, name), {}):
            folder, source = changed
            own = folder.parent.parent
            raise UserError(
                f"{own}: stage '{folder.name}' was made from another {source.say(folder)}, which has been "
                f"made anew since; finish the run: motionloom run {own / 'recipe.yaml'} -o {own}"
            )


def fingerprint_now(folder: Path) -> str | None:
    """Fingerprint of the stage in a folder, finished or not; None if there is none."""
    artifact = Artifact.find(folder)
    if artifact is not None:
        return artifact.fingerprint
    started = folder / "started.json"
    if not started.is_file():
        return None
    try:
        return str(parse_json(read_plain(started), str(started))["fingerprint"])
    except (UserError, KeyError, TypeError):
        raise UserError(
            f"{started}: not readable; delete the folder {folder} and run the recipe again"
        ) from None


# Checksums.

NOTE = ".compared.json"

_MACHINES = 64
"""States of a file that are noted."""


class ComparedFile(Config):
    """A file that had its sha256 when it was compared."""

    sha256: str
    states: list[State]
    """States of the file (`state_of`), the newest first: machines may have copies of their own."""


class Compared(Config):
    """`.compared.json`: shards by their path, files of stages by their path in the run."""

    files: dict[str, ComparedFile]

    @staticmethod
    def read(path: Path) -> Compared:
        """The stored note; an empty one where none can be read."""
        try:
            return Compared.load_json(path)
        except (UserError, OSError):
            return Compared(files={})

    def knows(self, name: str, sha256: str, state: State) -> bool:
        """Whether the file has been compared as it is."""
        known = self.files.get(name)
        return known is not None and known.sha256 == sha256 and state in known.states

    @staticmethod
    def add(path: Path, compared: Mapping[str, tuple[str, State]]) -> None:
        """Note in `path` the sha256 and the state of what has been compared, beside what other jobs note."""
        with file_lock(path.with_name(LOCK_FILE)):
            files = Compared.read(path).files
            for name, (sha256, state) in compared.items():
                before = files.get(name)
                others = before.states if before is not None and before.sha256 == sha256 else []
                files[name] = ComparedFile(sha256=sha256, states=[state, *others][:_MACHINES])
            write_json(path, Compared(files=files).dump())


def require_unchanged(folder: Path, *, again: bool = False) -> int:
    """Refuse a finished stage one of whose files is not the one that it made; how many were read.

    Those of an export are compared each time, those of a run once, or `again`. Shards are left
    to whoever reads them (`verify_shards.py`).
    """
    artifact = Artifact.find(folder)
    run = owner_of(folder)
    exported = in_export(folder)
    if artifact is None:
        return 0
    known = Compared(files={}) if exported or again else Compared.read(run / NOTE)
    compared: dict[str, tuple[str, State]] = {}
    for name, info in artifact.outputs.items():
        path = folder / name
        # Shards may be terabytes: whoever reads them compares them.
        if name.endswith(".tar"):
            continue
        key = f"stages/{folder.name}/{name}"
        state = state_of(path)
        if known.knows(key, info.sha256, state):
            continue
        if not state or state[0] != info.bytes or sha256_of(path) != info.sha256:
            maker = "was exported" if exported else "its stage made"
            what = f"is not the file that {maker} (another sha256)" if state else "is gone"
            again_by = f"motionloom run {run / 'recipe.yaml'} -o {run} --from {folder.name}"
            fix = "copy the folder again" if exported else f"copy it back, or make it again: {again_by}"
            raise UserError(f"{path}: {what}; {fix}")
        compared[key] = info.sha256, state
    if compared and not exported:
        with suppress(OSError):  # a run that may only be read
            Compared.add(run / NOTE, compared)
    return len(compared)
