"""What can be said about a submission without a cluster: its options, and the words for its failures."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from motionloom.datasets.schema import UserError
from motionloom.pipeline.launch import slurm_convert
from motionloom.pipeline.launch.convert_job import JobResult, main, result_path
from motionloom.pipeline.launch.slurm_convert import (
    ClusterConfig,
    Link,
    Submission,
    submit_conversion,
    wait_for,
)


def test_words_become_options() -> None:
    asked = ClusterConfig.from_words(["partition=cpu", "tasks=64", "memory_gb=2.5", "extra.mail-type=END"])
    assert (asked.partition, asked.tasks, asked.memory_gb) == ("cpu", 64, 2.5)
    assert asked.extra == {"mail-type": "END"}


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("partition", "write KEY=VALUE"),
        ("partitoin=cpu", "did you mean 'partition'"),
        ("tasks=none", "key 'tasks'"),
        ("tasks=0", "key 'tasks'"),
        ("extra.a\nrm=1", "an sbatch option is a word"),
        ("extra.mail-type=END\nrm -rf x", "an sbatch option is a word"),
    ],
)
def test_wrong_words_are_explained(word: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        ClusterConfig.from_words([word])


def test_without_a_cluster_it_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match="no sbatch here"):
        submit_conversion("bvh", {}, tmp_path, cluster=ClusterConfig(), console=Console(file=io.StringIO()))


def test_the_first_failure_is_told_with_its_reason_log_and_consequence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    links = (Link("features", "7", 1), Link("shards", "8", 3), Link("manifest", "9", 1))
    submission = Submission(tmp_path, tmp_path / "logs", links)
    (tmp_path / "logs").mkdir()
    answers = iter([["8", "9"], None, []])
    monkeypatch.setattr(slurm_convert, "_alive", lambda ids: next(answers))
    leave(submission, "features", 0)
    leave(submission, "shards", 0)
    leave(submission, "shards", 1, error="clip.bvh: no MOTION section")
    with pytest.raises(UserError) as failure:
        wait_for(submission, Console(file=io.StringIO()), poll_seconds=0)
    assert str(failure.value) == (
        "shards job 8: task 1 and 1 more of 3 failed: clip.bvh: no MOTION section; "
        f"log: {tmp_path / 'logs' / '8_1_0_log.err'}; cancelled: manifest job 9. "
        "The same command makes what is missing."
    )


def leave(submission: Submission, step: slurm_convert.Step, index: int, error: str = "") -> None:
    result = JobResult(ok=not error, message=error or "done", seconds=1.0, host="n1")
    result_path(submission.logs, step, index).write_text(json.dumps(result.dump()))


def test_a_squeue_that_never_answers_ends_the_waiting_not_the_jobs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(slurm_convert, "_alive", lambda ids: None)
    submission = Submission(tmp_path, tmp_path, (Link("shards", "8", 1),))
    with pytest.raises(UserError, match="squeue does not answer; the jobs go on: squeue --jobs 8"):
        wait_for(submission, Console(file=io.StringIO()), poll_seconds=0)


def test_a_job_leaves_its_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record = {"kind": "bvh", "fields": {"source": "nowhere"}, "out": str(tmp_path / "out")}
    (tmp_path / "job.json").write_text(json.dumps(record))
    assert main([str(tmp_path / "job.json"), "shards", "0", "2"]) == 1
    left = JobResult.load_json(tmp_path / "shards-000000.json")
    assert not left.ok and "key 'licence' is required" in left.message
    assert "shards 1 of 2: " in capsys.readouterr().out
