"""Loggers: the same names everywhere, every step once after a kill, nothing of it in the artifact."""

from __future__ import annotations

import csv
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from lightning.pytorch.loggers.logger import Logger
from rich.console import Console
from tiny_adversaries import train

from motionloom.datasets.base.errors import UserError
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


def without_clock(rows: list[dict[str, float]]) -> list[dict[str, float]]:
    """Without the flight recorder's figures, which differ from run to run."""
    return [{k: v for k, v in row.items() if not k.startswith("flight/")} for row in rows]


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
        if not tag.startswith("flight/"):
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
    """Notes the steps that it gets; what `fails` names ends with an error."""

    name, version = "noted", "0"

    def __init__(self, rows: list[int], fails: str = "") -> None:
        super().__init__()
        self.rows, self.fails = rows, fails
        self._act("open")

    def log_hyperparams(self, *_: Any, **__: Any) -> None:
        """Nothing."""

    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Note the step."""
        assert step is not None
        self._act("log" if step > 12 else "")
        self.rows.append(step)

    def save(self) -> None:
        """Nothing."""
        self._act("save")

    def finalize(self, status: str) -> None:
        """Nothing."""
        self._act("finalize")

    def _act(self, name: str) -> None:
        if name and name == self.fails:
            raise ConnectionError("no route [to host]\nand more")


def use(monkeypatch: pytest.MonkeyPatch, rows: list[int], fails: str = "") -> None:
    """Have a `Noted` stand for TensorBoard's logger."""
    monkeypatch.setitem(metric_log._MAKERS, "tensorboard", lambda *_: Noted(rows, fails))


def test_a_logger_gets_rows_with_their_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It cannot take one back: what a kill has undone must not have been sent."""
    sent: list[int] = []
    use(monkeypatch, sent)
    with pytest.raises(ConnectionResetError):
        train(tmp_path, hardware=FILES, dies_at=23, **STEPS)
    assert sent == [10, 12]
    # As if the kill had come when the checkpoint was on disk and its last row not yet sent.
    (tmp_path / "logs/sent.json").write_text('{"tensorboard": 1}')
    train(tmp_path, hardware=FILES, **STEPS)
    assert sent == [10, 12, 12, 20, 24, 30]


@pytest.mark.parametrize("fails", ["open", "log", "save", "finalize"])
def test_a_logger_that_fails_is_dropped(fails: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One warning; the training and the other logs go on, and a resumed one sends what is missing."""
    sent: list[int] = []
    use(monkeypatch, sent, fails)
    said = StringIO()
    with pytest.raises(ConnectionResetError):
        train(tmp_path, hardware=FILES, dies_at=29, console=Console(file=said, width=500), **STEPS)
    (line,) = [line for line in said.getvalue().splitlines() if "ConnectionError" in line]
    assert "logger tensorboard of test/duel" in line and line.endswith("no route [to host]")
    assert [row["step"] for row in read_training_log(tmp_path)] == [10, 12, 20, 24]
    assert [row["step"] for row in csv_rows(tmp_path)] == [10, 12, 20, 24]
    use(monkeypatch, sent)
    train(tmp_path, hardware=FILES, **STEPS)
    assert sorted({*sent}) == [row["step"] for row in csv_rows(tmp_path)] == [10, 12, 20, 24, 30]
    assert sent[-1] == 30 and (fails == "save" or len(sent) == 5)


def test_logs_that_cannot_be_written_end_no_training(tmp_path: Path) -> None:
    (tmp_path / "logs").write_text("")
    said = StringIO()
    train(tmp_path, hardware=FILES, console=Console(file=said, width=500), **STEPS)
    left_out = [line.split(" is left out")[0] for line in said.getvalue().splitlines() if "left out" in line]
    assert len(left_out) == 3 and {"logger csv", "logger tensorboard"} < {
        " ".join(line.split()[:2]) for line in left_out
    }
    assert [row["step"] for row in read_training_log(tmp_path)] == [10, 12, 20, 24, 30]


def test_a_server_knows_a_training_that_goes_on(tmp_path: Path) -> None:
    console = Console(quiet=True)
    first, again = (MetricLog(tmp_path, (), "p", "t", console).identity("wandb") for _ in range(2))
    assert first == again != MetricLog(tmp_path / "other", (), "p", "t", console).identity("wandb")


def killed_and_resumed(folder: Path, name: str) -> None:
    """Two trainings of one process with a logger; the second is killed and goes on. No warning is given."""
    said = StringIO()
    console, hardware = Console(file=said, width=500), {"loggers": (name, "csv")}
    train(folder / "first", hardware=hardware, console=console, **STEPS)
    with pytest.raises(ConnectionResetError):
        train(folder / "second", hardware=hardware, console=console, dies_at=23, **STEPS)
    train(folder / "second", hardware=hardware, console=console, **STEPS)
    assert "logger" not in said.getvalue()
    assert {path.name for path in folder.iterdir()} == {"first", "second"}


def test_mlflow_has_every_row_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mlflow = pytest.importorskip("mlflow", reason="the extra mlflow is not installed")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(metric_log, "_MLFLOW_SERVER", None)
    killed_and_resumed(tmp_path, "mlflow")
    for folder in (tmp_path / "first", tmp_path / "second"):
        client = mlflow.MlflowClient(f"sqlite:///{folder}/logs/mlflow.db")
        experiment = client.get_experiment_by_name("test").experiment_id
        (run,) = client.search_runs([experiment])
        assert run.info.run_name == "test/duel" and run.info.status == "FINISHED"
        for name in ("train/loss", "val/loss"):
            logged = [(m.step, m.value) for m in client.get_metric_history(run.info.run_id, name)]
            rows = [(row["step"], row[name]) for row in read_training_log(folder) if name in row]
            assert logged == rows


def test_wandb_knows_a_training_that_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb", reason="the extra wandb is not installed")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "offline")
    killed_and_resumed(tmp_path, "wandb")
    ids = set()
    for folder, runs in ((tmp_path / "first", 1), (tmp_path / "second", 2)):
        paths = sorted(folder.glob("logs/wandb/offline-run-*/*.wandb"))
        assert len(paths) == runs
        ids |= {path.stem for path in paths}
    assert len(ids) == 2


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_a_missing_package_is_named_with_its_extra(name: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(UserError, match=rf"pip install 'motionloom\[{name}\]'"):
        TmaStageConfig().require_fit(Hardware(accelerator="cpu", loggers=("csv", name)))
