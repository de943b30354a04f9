"""The blocks of docs/library.md run, in order, in one program."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[1] / "docs" / "library.md"


def test_the_blocks_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = PAGE.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    names: dict[str, object] = {"__name__": "library"}
    for block in re.findall(r"^```python\n(.*?)^```$", text, re.M | re.S):
        exec(compile(block, str(PAGE), "exec"), names)
    best = names["best"]
    assert Path(best.best_model_path).is_file()  # type: ignore[attr-defined]
    assert names["trainer"].callback_metrics["val/loss"].isfinite()  # type: ignore[attr-defined]
