"""Khronos' validator of glTF files."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

VALIDATE = """
import { pathToFileURL } from "node:url";
import fs from "node:fs";
const { default: validator } = await import(pathToFileURL(process.argv[1]).href);
const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])));
console.log(JSON.stringify(report));
"""


def validated(path: Path) -> dict[str, Any]:
    """The validator's report; skips where it is not: `MOTIONLOOM_NODE_MODULES` names a folder that has it."""
    module = Path(os.environ.get("MOTIONLOOM_NODE_MODULES", "")) / "gltf-validator" / "index.js"
    node = shutil.which("node")
    if node is None or not module.is_file():
        pytest.skip("MOTIONLOOM_NODE_MODULES names no folder with gltf-validator, or there is no node")
    command = [node, "--input-type=module", "-e", VALIDATE, str(module), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    report: dict[str, Any] = json.loads(done.stdout)
    return report
