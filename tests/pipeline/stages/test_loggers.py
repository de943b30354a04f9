"""Loggers: the same names everywhere, every step once after a kill, nothing of it in the artifact."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest
from lightning.pytorch.loggers.logger import Logger
from tiny_adversaries import train

from motionloom.datasets.schema import UserError
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.stages.networks.tma import TmaStageConfig
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.training_log import read_training_log
from motionloom.pipeline.training import metric_log
from motionloom.pipeline.training.metric_log import MetricLog

FILES = {"loggers": ("tensorboard", "csv")}
STEPS: dict[str, Any] = {"steps": 30, "checkpoint_every": 12, "validate_every": 12}


def csv_rows(folder: Path) -> list[dict[str, float]]:
    with (folder / "logs/csv/metrics.csv").open() as file:
        return [{k: float(v) for k, v in row.items() if v} for row in csv.DictReader(file)]


def events(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Scalars as TensorBoard shows them."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    found = EventAccumulator(str(folder / "logs/tensorboard"))
    found.Reload()
    return {tag: [(e.step, e.value) for e in found.Scalars(tag)] for tag in found.Tags()["scalars"]}


def tells_time(name: str) -> bool:
    """Of the flight recorder's figures the norms are the same in every run, and the others are not."""
    return name.startswith("flight/")


def without_clock(rows: list[dict[str, float]]) -> list[dict[str, float]]:
    return [{k: v for k, v in row.items() if not tells_time(k)} for row in rows]


def test_files_hold_every_step_once_after_a_kill(tmp_path: Path) -> None:
    train(tmp_path / "whole", hardware=FILES, **STEPS)
    for step in (23, 29):  # behind a row that no checkpoint holds
        with pytest.raises(ConnectionResetError):
            train(tmp_path / "killed", hardware=FILES, dies_at=step, **STEPS)
    train(tmp_path / "killed", hardware=FILES, **STEPS)
    whole = without_clock(csv_rows(tmp_path / "whole"))
    assert without_clock(csv_rows(tmp_path / "killed")) == whole
    assert [row["step"] for row in whole] == [10, 12, 20, 24, 30]
    shown = [events(tmp_path / name) for name in ("whole", "killed")]
    assert shown[0].keys() == shown[1].keys()
    for tag, values in shown[0].items():
        if not tells_time(tag):
            assert shown[1][tag] == values, tag


def test_all_get_the_rows_of_the_metrics_file_and_more(tmp_path: Path) -> None:
    train(tmp_path, hardware=FILES, **STEPS)
    rows, logged = read_training_log(tmp_path), csv_rows(tmp_path)
    for row, more in zip(rows, logged, strict=True):
        assert {name: more[name] for name in row} == row
    extra = {"lr/generator", "grad_norm/generator", "lr/critic", "grad_norm/critic"}
    more = {name for name in logged[2].keys() - rows[2].keys() if not name.startswith("flight/")}
    assert {"lr/generator", "grad_norm/generator"} <= more <= extra
    assert {"flight/step_seconds", "flight/waited/data"} <= logged[2].keys()
    assert set(events(tmp_path)) == {name for row in logged for name in row} - {"step"}
    # Logs are no output.
    blank = Artifact(
        stage="duel", kind="duel", version=1, fingerprint="", seed=0, config={}, inputs={}
    ).finish(tmp_path)
    assert set(blank.outputs) == {"metrics.jsonl"}


class Noted(Logger):
    """Notes what it gets."""

    name, version = "noted", "0"

    def __init__(self, rows: list[int]) -> None:
        super().__init__()
        self.rows = rows

    def log_hyperparams(self, *_: Any, **__: Any) -> None:
        """Nothing."""

    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Note the step."""
        assert step is not None
        self.rows.append(step)


def test_a_logger_gets_rows_with_their_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It cannot take one back: what a kill has undone must not have been sent."""
    sent: list[int] = []
    monkeypatch.setitem(metric_log._MAKERS, "wandb", lambda *_: Noted(sent))
    server = {"loggers": ("wandb",)}
    with pytest.raises(ConnectionResetError):
        train(tmp_path, hardware=server, dies_at=23, **STEPS)
    assert sent == [10, 12]
    # As if the kill had come when the checkpoint was on disk and its last row not yet sent.
    (tmp_path / "logs/sent.json").write_text('{"step": 10}')
    train(tmp_path, hardware=server, **STEPS)
    assert sent == [10, 12, 12, 20, 24, 30]


def test_a_server_knows_a_training_that_goes_on(tmp_path: Path) -> None:
    first, again = (MetricLog(tmp_path, (), "p", "t").identity("wandb") for _ in range(2))
    assert first == again != MetricLog(tmp_path / "other", (), "p", "t").identity("wandb")


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_a_missing_package_is_named_with_its_extra(name: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(UserError, match=rf"pip install 'motionloom\[{name}\]'"):
        TmaStageConfig().require_fit(Hardware(accelerator="cpu", loggers=("csv", name)))
