"""People's decisions about suspect clips: which are left out, and which are good after all.

`cleaned.json` beside the shards holds the decisions, so that they last when the set is converted again. The
manifest lists what is left out; readers skip it. Since the manifest's checksum is what a run knows a data set
by, stages that have read other clips run again. No shard changes, and without the list all is as before.
"""

from __future__ import annotations

from pathlib import Path

from motionloom.datasets.base.files import write_json
from motionloom.datasets.base.lock import folder_lock
from motionloom.datasets.schema import CLEANED_FILE, MANIFEST_FILE, SPLITS, Decisions, Manifest, UserError
from motionloom.datasets.shards.reader import ShardDataset, load_manifest


def decide(root: Path, given: Decisions, where: str) -> Manifest:
    """Add decisions, those of the file `where`, to a data set; its manifest as it is then."""
    with folder_lock(root):
        manifest, decided = load_manifest(root), Decisions.of(root).then(given)
        here = {shard.split for shard in manifest.shards}
        opened = [ShardDataset.open(root, split, every=True) for split in SPLITS if split in here]
        ids = {dataset.split: set(dataset.ids) for dataset in opened}
        unknown = sorted({*given.left_out, *given.kept}.difference(*ids.values()))
        if unknown:
            raise UserError(f"{where}: no clip '{unknown[0]}' in {root}; it is about another data set")
        for split, own in ids.items():
            if own <= decided.left_out.keys():
                raise UserError(f"{where}: leaves out every clip of split '{split}' of {root}; keep some")
        write_json(root / CLEANED_FILE, decided.dump())
        return _written(root, manifest, decided.left_out)


def undo(root: Path) -> Manifest:
    """Forget all decisions about a data set."""
    with folder_lock(root):
        manifest = load_manifest(root)
        (root / CLEANED_FILE).unlink(missing_ok=True)
        return _written(root, manifest, {})


def _written(root: Path, manifest: Manifest, excluded: dict[str, str]) -> Manifest:
    manifest = manifest.model_copy(update={"excluded": excluded})
    write_json(root / MANIFEST_FILE, manifest.dump())
    return manifest
