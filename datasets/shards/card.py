"""`README.md` beside the shards: what a hub, and `datasets.load_dataset(FOLDER)`, take for the data.

Its head names the tars of each split and the type of every member, since other readers guess both: they take
JSON records for rows, and the members of the first few clips for those of all.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.files import write_text
from motionloom.datasets.base.records import Caption, ClipMeta, Manifest

CARD_FILE = "README.md"

_OURS = "---\n# Written by motionloom. Without this line the file is yours, and stays.\n"
_HUB_LICENCE = re.compile(r"mit|apache-2\.0|cc0-1\.0|cc-by(?:-sa)?-[34]\.0|cc-by-nc(?:-sa|-nd)?-[34]\.0")
"""Licences that the hub knows by name."""
_HUB_SPLITS = {"val": "validation"}
_TYPES = {"number": "float64", "integer": "int64", "boolean": "bool"}
"""Names of types: in JSON schemas, and on the hub."""


def write_card(out: Path, manifest: Manifest, members: Iterable[str]) -> None:
    """Write the card of a data set whose clips have these members; one that is the user's own stays."""
    path = out / CARD_FILE
    if path.is_file() and not path.read_text(encoding="utf-8", errors="replace").startswith(_OURS):
        return
    splits = dict.fromkeys(shard.split for shard in manifest.shards)
    files = [
        {"split": _HUB_SPLITS.get(split, split), "path": f"{manifest.name}-{split}-*.tar"} for split in splits
    ]
    features = [{"name": member, **_feature(member)} for member in members]
    features += [{"name": name, "dtype": "string"} for name in ("__key__", "__url__")]
    facts = {
        "tags": ["human-motion", "webdataset"],
        "configs": [{"config_name": "default", "data_files": files}],
        "dataset_info": {"features": features},
    }
    said = f"Motion clips, layout {manifest.layout} at {manifest.fps:g} fps, for motionloom."
    text = hub_card(manifest.name, manifest.licence, facts, said, manifest.credits)
    write_text(path, text.replace("---\n", _OURS, 1))


def hub_card(title: str, licence: str, facts: Mapping[str, Any], said: str, credits: Iterable[str]) -> str:
    """The text of a card: licence and further facts for the hub; a sentence, and who is to be named."""
    known = licence.lower() if _HUB_LICENCE.fullmatch(licence.lower()) else None
    named = {"license": known} if known else {"license": "other", "license_name": licence}
    head = yaml.safe_dump({**named, **facts}, sort_keys=False, allow_unicode=True)
    wherever = ["Wherever these, or what is made of them, are shown:"] if credits else []
    named_ones = [f"- {credit}" for credit in credits]
    parts = [f"---\n{head}---", f"# {title}", said, f"Licence: {licence}.", *wherever, *named_ones]
    return "\n\n".join(parts) + "\n"


def _feature(member: str) -> dict[str, Any]:
    """The type of a member in the hub's words."""
    if member.endswith(".npy"):
        return {"list": {"list": "float32"}}
    if member.endswith(".flac"):
        return {"dtype": "audio"}
    return {"struct": _fields(ClipMeta)} if member == "meta.json" else {"list": _fields(Caption)}


def _fields(record: type[Config]) -> list[dict[str, str]]:
    stored = record.model_json_schema(mode="serialization")["properties"]
    return [{"name": name, "dtype": _TYPES.get(kind.get("type"), "string")} for name, kind in stored.items()]
