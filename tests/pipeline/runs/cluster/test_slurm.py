"""What SLURM is given, jobs one after the other, and a batch script as bash runs it."""

from __future__ import annotations

import io
import os
import shlex
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.launch.cluster import ClusterOptions
from motionloom.pipeline.runs.cluster import slurm
from motionloom.pipeline.runs.cluster.launch import launch_recipe
from motionloom.pipeline.runs.cluster.launch_plan import make_launch_plan
from motionloom.pipeline.runs.recipe import load_recipe

NASTY = """it's a "$(HOME)" `x`; touch y"""


def scripts(folder: Path, recipe: str, *words: str, nodes: int = 1, gpus: int = 0) -> list[slurm.Script]:
    options, out = ClusterOptions().with_words(words), folder / (NASTY if "paper" in recipe else "run")
    plan = make_launch_plan(load_recipe(recipe), options, out=out, nodes=nodes, gpus_per_node=gpus)
    return slurm.slurm_scripts([plan], options, folder, folder)


def console() -> Console:
    return Console(file=io.StringIO(), width=200)


def said(to: Console) -> str:
    assert isinstance(to.file, io.StringIO)
    return to.file.getvalue()


def after(words: list[str], option: str) -> list[str]:
    return [words[place + 1] for place, word in enumerate(words) if word == option]


def asked(script: slurm.Script) -> dict[str, str]:
    lines = [line for line in script.text.splitlines() if line.startswith("#SBATCH ")]
    pairs = [shlex.split(line.removeprefix("#SBATCH "))[0].partition("=") for line in lines]
    return {name.removeprefix("--"): value for name, _, value in pairs}


def test_scripts_ask_for_a_task_a_gpu(tmp_path: Path) -> None:
    words = ("partition=gpu", "light_partition=cpu", "extra.comment=a b", "clips_per_gpu=16")
    first, train, *_, last = scripts(tmp_path, "humantomato-paper", *words, nodes=2, gpus=8)
    found = asked(train)
    for option in ("ntasks-per-node", "gpus-per-node", "cpus-per-task"):
        assert found[option] == "8"
    assert found["nodes"] == "2"
    assert found["signal"] == "B:USR1@120" and found["kill-on-invalid-dep"] == "yes" and "requeue" in found
    assert found["comment"] == "a b" and found["open-mode"] == "append"
    assert [asked(script)["partition"] for script in (first, train, last)] == ["cpu", "gpu", "gpu"]
    assert "gpus-per-node" not in asked(first) and asked(last)["gpus-per-node"] == "1"
    line = next(line for line in train.text.splitlines() if line.startswith("srun"))
    words = shlex.split(line)
    assert words[-1] == "&" and after(words, "-o") == [str(tmp_path / NASTY)]
    assert {"--nodes=2", "--ntasks-per-node=8", "--gpus-per-node=8"} <= set(words)
    assert not any(line.startswith("srun") for line in first.text.splitlines())
    assert train.submit({"1-data": ["17"]}) == [
        "sbatch",
        "--parsable",
        "--dependency=afterok:17",
        str(train.path),
    ]


def test_parts_are_an_array(tmp_path: Path) -> None:
    parts, data, *_ = scripts(tmp_path, "bvh-body", "parts=8")
    assert asked(parts)["array"] == "1-8" and asked(parts)["output"].endswith("1-parts-%A_%a.log")
    assert "array" not in asked(data) and "hardware.part" not in data.text


def fake_sbatch(folder: Path, monkeypatch: pytest.MonkeyPatch, refuse: str = "") -> Path:
    """Programs that write down how they were called; sbatch refuses scripts of that name."""
    folder.mkdir()
    record = folder / "calls"
    for name in ("sbatch", "scancel"):
        program = folder / name
        lines = [
            f'echo {name} "$@" >> {shlex.quote(str(record))}',
            f'case "$*" in *{refuse or "no-such"}*) echo "no such partition" >&2; exit 1;; esac',
            f"wc -l < {shlex.quote(str(record))}",
        ]
        program.write_text("#!/bin/sh\n" + "\n".join(lines) + "\n")
        program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
    return record


def test_jobs_are_submitted_behind_what_they_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record = fake_sbatch(tmp_path / "bin", monkeypatch)
    out, to = tmp_path / "run", console()
    launch_recipe("humantomato-tiny", gpus_per_node=1, out=out, overrides=["tma.train.steps=5"], console=to)
    calls = [line.split() for line in record.read_text().splitlines()]
    # Data; tokenizer, face, TMA; GPT; evaluation; motions and report.
    behind = [words[2].removeprefix("--dependency=afterok:") for words in calls[1:]]
    assert behind == ["1", "1", "1", "2:4", "3:5", "6"]
    written = sorted(Path(words[-1]) for words in calls)
    assert all(path.is_file() and path.parent.parent == out / ".slurm" for path in written)
    resolved = load_recipe(written[0].parent / "recipe.yaml")
    assert resolved == load_recipe("humantomato-tiny", ["tma.train.steps=5"])
    assert all("recipe.yaml -o" in path.read_text() for path in written)
    assert "scancel 1 2 3 4 5 6 7" in said(to)


def test_a_refused_job_takes_those_before_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record = fake_sbatch(tmp_path / "bin", monkeypatch, refuse="2-tokenizer.sbatch")
    with pytest.raises(UserError, match=r"2-tokenizer.sbatch: no such partition"):
        launch_recipe("humantomato-tiny", gpus_per_node=1, out=tmp_path / "run", console=console())
    assert record.read_text().splitlines()[-1] == "scancel 1"


def test_without_a_cluster_in_a_dry_run_or_in_anothers_folder_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="no sbatch here"):
        launch_recipe("humantomato-tiny", gpus_per_node=1, out=tmp_path / "run", console=console())
    to = console()
    # Data that are elsewhere, so that nothing is estimated.
    away = ("stages.data={kind: shards, path: elsewhere}",)
    launch_recipe("humantomato-tiny", gpus_per_node=1, overrides=away, dry_run=True, console=to)
    assert "2-tokenizer" in said(to) and "until evaluate" in " ".join(said(to).replace("- ", "").split())
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "recipe.yaml").write_text("name: other\n")
    with pytest.raises(UserError, match="recipe 'other'"):
        launch_recipe("humantomato-tiny", gpus_per_node=1, out=tmp_path, dry_run=True, console=console())


def test_a_folder_with_a_line_break_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a\n#SBATCH --wrap=x").mkdir()
    with pytest.raises(UserError, match=r"--out .*not printable"):
        launch_recipe("humantomato-tiny", out=tmp_path / "a\nb", dry_run=True, console=console())
    monkeypatch.chdir(tmp_path / "a\n#SBATCH --wrap=x")
    with pytest.raises(UserError, match="not printable"):
        launch_recipe("humantomato-tiny", out=tmp_path, dry_run=True, console=console())


@pytest.fixture
def job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts a script of one process as SLURM would, with a command and a `scontrol` of ours."""
    jobs: list[subprocess.Popen[str]] = []

    def start(
        command: str, scontrol: str = "exit 1", restarts: int = 0, **more: str
    ) -> subprocess.Popen[str]:
        monkeypatch.setattr(slurm, "PROGRAM", ("sh", "-c", command, "motionloom"))
        path, program = tmp_path / "job.sbatch", tmp_path / "scontrol"
        path.write_text(scripts(tmp_path, "bvh-body", "parts=8")[0 if more else 1].text)
        program.write_text(f'#!/bin/sh\necho "$@" > asked; {scontrol}\n')
        program.chmod(0o755)
        env = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "SLURM_JOB_ID": "7"}
        env |= {"SLURM_RESTART_COUNT": str(restarts), **more}
        jobs.append(
            subprocess.Popen(["bash", str(path)], env=env, text=True, cwd=tmp_path, start_new_session=True)
        )
        return jobs[-1]

    yield start
    for one in jobs:
        if one.poll() is None:
            os.killpg(one.pid, signal.SIGKILL)
        one.wait(30)


@pytest.mark.parametrize("code", [0, 3])
def test_a_job_ends_as_its_command(job: Callable[..., Any], code: int) -> None:
    assert job(f"exit {code}").wait(30) == code


@pytest.mark.parametrize(
    ("answer", "count", "scontrol", "code"),
    [
        ("exit 75", 0, "exit 0", None),  # a training that saves
        ("", 0, "exit 0", None),  # a command that the signal ends
        ("exit 75", 0, "exit 1", 75),  # SLURM refuses
        ("exit 3", 0, "exit 0", 3),  # it has failed meanwhile
        ("exit 0", 0, "exit 0", 0),  # it was done
        ("exit 75", 100, "exit 0", 4),  # often enough: it may still finish
    ],
)
def test_a_warning_reaches_the_command(
    job: Callable[..., Any], tmp_path: Path, answer: str, count: int, scontrol: str, code: int | None
) -> None:
    """Then its job is queued again, where it has ended as one that is to go on."""
    trap = f"trap {shlex.quote(answer)} USR1; " if answer else ""
    waiting = f"{trap}touch started; while [ ! -e go ]; do sleep 0.02; done; exit 4"
    started, asked = job(waiting, scontrol, count), tmp_path / "asked"
    wait_until((tmp_path / "started").exists)
    started.send_signal(signal.SIGUSR1)
    if code == 4:
        (tmp_path / "go").touch()
    if code is not None:
        assert started.wait(30) == code
    if code in (None, 75):
        wait_until(lambda: asked.exists() and asked.read_text() == "requeue 7\n")
    else:
        assert not asked.exists()
    if code is None:
        time.sleep(0.1)
        assert started.poll() is None  # it waits for SLURM to end it


def test_a_part_alone_is_queued_again(job: Callable[..., Any], tmp_path: Path) -> None:
    """It knows its own number, and the array's id is that of all parts."""
    command = "trap 'exit 75' USR1; echo $@ > given; while :; do sleep 0.02; done"
    started = job(command, "exit 0", SLURM_ARRAY_JOB_ID="5", SLURM_ARRAY_TASK_ID="3")
    given, again = tmp_path / "given", tmp_path / "asked"
    wait_until(given.exists)
    assert given.read_text().split()[-2:] == ["--set", "hardware.part=3/8"]
    started.send_signal(signal.SIGUSR1)
    wait_until(lambda: again.exists() and again.read_text() == "requeue 5_3\n")


def test_the_end_of_a_job_reaches_the_command(job: Callable[..., Any], tmp_path: Path) -> None:
    """A preemption: SLURM queues the job again by itself."""
    started = job("trap 'touch saved; exit 75' TERM; touch started; while :; do sleep 0.02; done")
    wait_until((tmp_path / "started").exists)
    started.send_signal(signal.SIGTERM)
    assert started.wait(30) == 75
    assert (tmp_path / "saved").exists() and not (tmp_path / "asked").exists()


def wait_until(ready: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30
    while not ready():
        assert time.monotonic() < deadline
        time.sleep(0.02)
