"""Files compared with the sha256 that is written down of them, once as long as they do not change.

What has been compared is noted in `.compared.json` of the run, so whoever opens a file next only looks
whether it is as it was: same size, times and number on the disk.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.schema import Config, UserError
from motionloom.datasets.shards.checksums import state_of
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.files import write_json
from motionloom.pipeline.store.run_folder import in_export, owner_of

NOTE = ".compared.json"

State = list[int]


class ComparedFile(Config):
    """A file that had its sha256 when it was compared."""

    sha256: str
    states: list[State]
    """State of the file (`state_of`): one on a shared file system, else one for each machine."""


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

    def write(self, path: Path, compared: Mapping[str, ComparedFile]) -> None:
        write_json(path, Compared(files=self.files | dict(compared)).dump())


def require_unchanged(folder: Path, *, again: bool = False) -> int:
    """Refuse a finished stage one of whose files is not the one that it made; how many were read.

    Those of an export are compared each time.

    Shards are left to whoever reads them (`verify_shards.py`), unless `again` has all compared once more.
    """
    artifact, run, exported = Artifact.find(folder), owner_of(folder), in_export(folder)
    if artifact is None:
        return 0
    known = Compared(files={}) if again or exported else Compared.read(run / NOTE)
    compared: dict[str, ComparedFile] = {}
    for name, info in artifact.outputs.items():
        path = folder / name
        # Shards may be terabytes: whoever reads them compares them.
        if name.endswith(".tar") and not again:
            continue
        key, state = f"stages/{folder.name}/{name}", state_of(path)
        if known.knows(key, info.sha256, state):
            continue
        if not state or state[0] != info.bytes or sha256_of(path) != info.sha256:
            maker = "was exported" if exported else "its stage made"
            what = f"is not the file that {maker} (another sha256)" if state else "is gone"
            again_by = f"motionloom run {run / 'recipe.yaml'} -o {run} --from {folder.name}"
            fix = "copy the folder again" if exported else f"copy it back, or make it again: {again_by}"
            raise UserError(f"{path}: {what}; {fix}")
        compared[key] = ComparedFile(sha256=info.sha256, states=[state])
    if compared and not exported:
        with suppress(OSError):  # a run that may only be read
            Compared.read(run / NOTE).write(run / NOTE, compared)
    return len(compared)
