"""What an engine is given: valid objects, words that arrive as they are, nothing written in a dry run."""

from __future__ import annotations

import io
import os
import shlex
import subprocess
from pathlib import Path, PurePosixPath
from typing import Any

import pytest
import yaml
from cluster_schemas import ConfigMap, Job, SkyTask, TrainJob, kubernetes_object
from rich.console import Console

from motionloom.datasets.schema import UserError
from motionloom.pipeline.cluster import slurm_run
from motionloom.pipeline.cluster.command import launch_recipe
from motionloom.pipeline.cluster.plan import LaunchPlan, make_launch_plan
from motionloom.pipeline.launch.options import KubernetesOptions, SkyPilotOptions, SlurmOptions
from motionloom.pipeline.runs.recipe import Recipe, load_recipe

NASTY = """data.path=it's a "$(HOME)" `x`; touch y"""
POD = ["image=registry/motionloom:1", "claim=data"]
SKY = ["image=registry/motionloom:1", "storage=volume", "accelerator=H100"]


@pytest.fixture(scope="module")
def paper() -> Recipe:
    return load_recipe("humantomato-paper", [NASTY])


def plan_of(recipe: Recipe, options: Any, **changes: Any) -> LaunchPlan:
    fields = {"given": "humantomato-paper", "overrides": (NASTY,), "nodes": 2, "gpus_per_node": 8}
    fields |= {"out": PurePosixPath("/motionloom/runs/x")} | changes
    return make_launch_plan(recipe, options, **fields)


def console() -> Console:
    return Console(file=io.StringIO(), width=200)


def said(to: Console) -> str:
    assert isinstance(to.file, io.StringIO)
    return to.file.getvalue()


def after(words: list[str], option: str) -> list[str]:
    return [words[place + 1] for place, word in enumerate(words) if word == option]


# Kubernetes.


def objects(plan: LaunchPlan, options: KubernetesOptions) -> list[Job | TrainJob | ConfigMap]:
    from motionloom.pipeline.cluster.kubernetes_run import kubernetes_yaml

    return [kubernetes_object(data) for data in yaml.safe_load_all(kubernetes_yaml(plan, options))]


def test_several_nodes_are_a_train_job_and_all_but_the_first_wait(paper: Recipe) -> None:
    options = KubernetesOptions.from_words([*POD, "namespace=ml", "runtime=torch-ours", "user=1234"])
    first, train, last = objects(plan_of(paper, options), options)
    assert isinstance(first, Job) and isinstance(train, TrainJob) and isinstance(last, Job)
    assert [one.spec.suspend for one in (first, train, last)] == [False, True, True]
    assert {one.metadata.namespace for one in (first, train, last)} == {"ml"}
    trainer = train.spec.trainer
    assert (trainer.numNodes, trainer.numProcPerNode) == (2, 8)
    assert trainer.resourcesPerNode.limits["nvidia.com/gpu"] == "8"
    assert trainer.command[:5] == ["env", "--chdir=/motionloom", "torchrun", "--no-python", "motionloom"]
    pod = train.spec.runtimePatches[0].trainingRuntimeSpec.template.spec.replicatedJobs[0].template.spec
    assert pod.template.spec.securityContext == first.spec.template.spec.securityContext
    assert pod.template.spec.securityContext.runAsUser == 1234
    assert train.spec.runtimeRef.name == "torch-ours"
    assert "nvidia.com/gpu" not in first.spec.template.spec.containers[0].resources.limits


def test_kubernetes_expands_nothing_of_the_users_words(paper: Recipe) -> None:
    options = KubernetesOptions.from_words(POD)
    for one in objects(plan_of(paper, options), options):
        assert isinstance(one, (Job, TrainJob))
        words = (
            one.spec.template.spec.containers[0].command if isinstance(one, Job) else one.spec.trainer.command
        )
        # Kubernetes takes $$ for one dollar and $(NAME) for a variable.
        assert "$" not in "".join(words).replace("$$", "")
        assert after(words, "--set")[0].replace("$$", "$") == NASTY


def test_one_node_needs_no_kubeflow(paper: Recipe) -> None:
    options = KubernetesOptions.from_words(POD)
    _, train, _ = objects(plan_of(paper, options, nodes=1), options)
    assert isinstance(train, Job)
    command = train.spec.template.spec.containers[0].command
    assert command[2:7] == ["torchrun", "--standalone", "--nproc-per-node=8", "--no-python", "motionloom"]


def test_parts_are_an_indexed_job() -> None:
    options = KubernetesOptions.from_words([*POD, "parts=5"])
    recipe = load_recipe("bvh-body")
    plan = plan_of(
        recipe, options, given="bvh-body", overrides=(), nodes=1, gpus_per_node=1, parts=options.parts
    )
    features, shards, rest = objects(plan, options)[:3]
    assert isinstance(features, Job) and isinstance(shards, Job) and isinstance(rest, Job)
    for one in (features, shards):
        assert (one.spec.completionMode, one.spec.completions) == ("Indexed", 5)
        env = {variable.name: variable.value for variable in one.spec.template.spec.containers[0].env}
        assert env["MOTIONLOOM_WORKERS"] == "8"
    assert rest.spec.completionMode == "NonIndexed"


def test_an_own_recipe_travels_resolved(paper: Recipe) -> None:
    options = KubernetesOptions.from_words(POD)
    recipe, first, train, _ = objects(plan_of(paper, options, given=None), options)
    assert isinstance(recipe, ConfigMap) and isinstance(first, Job) and isinstance(train, TrainJob)
    assert recipe.data == {"recipe.yaml": paper.to_yaml()}
    pod = train.spec.runtimePatches[0].trainingRuntimeSpec.template.spec.replicatedJobs[0].template.spec
    for command, volumes, mounts in (
        (
            first.spec.template.spec.containers[0].command,
            first.spec.template.spec.volumes,
            first.spec.template.spec.containers[0].volumeMounts,
        ),
        (train.spec.trainer.command, pod.template.spec.volumes, pod.template.spec.containers[0].volumeMounts),
    ):
        assert command[command.index("run") + 1] == "/etc/motionloom/recipe.yaml"
        assert NASTY not in command
        assert any(v.configMap and v.configMap.name == recipe.metadata.name for v in volumes)
        assert any(mount.mountPath == "/etc/motionloom" and mount.readOnly for mount in mounts)


def test_the_steps_wait_for_each_group_and_resume_the_next(paper: Recipe) -> None:
    from motionloom.pipeline.cluster.kubernetes_run import kubernetes_steps

    options = KubernetesOptions.from_words([*POD, "namespace=ml"])
    steps = [shlex.split(step) for step in kubernetes_steps(plan_of(paper, options), options, "a file.yaml")]
    assert [words[1] for words in steps] == ["apply", "wait", "patch", "wait", "patch", "wait"]
    assert steps[0][-1] == "a file.yaml"
    assert all(after(words, "--namespace") == ["ml"] for words in steps)
    assert "trainjob/humantomato-paper-2-train" in steps[2] and "--for=condition=Complete" in steps[3]
    assert after(steps[2], "--patch") == ['{"spec":{"suspend":false}}']


def test_a_run_folder_outside_the_claim_is_refused(paper: Recipe) -> None:
    options = KubernetesOptions.from_words(POD)
    with pytest.raises(UserError, match="would vanish with its pod"):
        objects(plan_of(paper, options, out=PurePosixPath("/tmp/x")), options)


# SkyPilot.


def tasks(plan: LaunchPlan, options: SkyPilotOptions, recipe: Path | None = None) -> list[SkyTask]:
    from motionloom.pipeline.cluster.skypilot_run import skypilot_yaml

    found = yaml.safe_load_all(skypilot_yaml(plan, options, recipe))
    return [SkyTask.model_validate(task) for task in found]


def test_a_chain_of_tasks_each_with_its_machines(paper: Recipe) -> None:
    options = SkyPilotOptions.from_words([*SKY, "infra=k8s", "use_spot=true"])
    head, first, train, last = tasks(plan_of(paper, options), options)
    assert head.model_dump(exclude_unset=True) == {"name": "humantomato-paper"}
    assert [task.num_nodes for task in (first, train, last)] == [1, 2, 1]
    asked = [task.resources.accelerators for task in (first, train, last) if task.resources]
    assert asked == [None, {"H100": 8}, {"H100": 1}]
    assert all(task.volumes == {"/motionloom": "volume"} for task in (first, train, last))
    assert train.run is not None and "torchrun" in train.run and first.run is not None
    for variable in ("SKYPILOT_NUM_NODES", "SKYPILOT_NODE_RANK", "SKYPILOT_NODE_IPS"):
        assert f'"${variable}"' in train.run


def test_the_shell_of_a_task_gets_the_words_as_they_are(paper: Recipe, tmp_path: Path) -> None:
    options = SkyPilotOptions.from_words([*SKY, f"mount={tmp_path}"])
    plan = plan_of(paper, options, out=PurePosixPath(tmp_path) / "run")
    told = tmp_path / "told"
    for name in ("motionloom", "torchrun"):
        program = tmp_path / name
        program.write_text(f'#!/bin/sh\nprintf "%s\\n" "$@" >> {shlex.quote(str(told))}\n')
        program.chmod(0o755)
    given = {"SKYPILOT_NUM_NODES": "2", "SKYPILOT_NODE_RANK": "1", "SKYPILOT_NODE_IPS": "10.0.0.1\n10.0.0.2"}
    for task in tasks(plan, options)[1:3]:
        assert task.run is not None
        path = {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
        subprocess.run(["bash", "-c", task.run], check=True, env=given | path)
    words = told.read_text().splitlines()
    assert words.count(NASTY) == 2 and not (tmp_path / "y").exists()
    assert after(words, "--node-rank") == ["1"] and after(words, "--master-addr") == ["10.0.0.1"]


def test_a_bucket_is_for_one_node(paper: Recipe, tmp_path: Path) -> None:
    words = ["storage=s3://bucket", "accelerator=H100", f"workdir={tmp_path}"]
    options = SkyPilotOptions.from_words(words)
    with pytest.raises(UserError, match="do not see each other's files"):
        tasks(plan_of(paper, options), options)
    recipe = tmp_path / "r.yaml"
    train = tasks(plan_of(paper, options, nodes=1, given=None), options, recipe)[2]
    assert train.setup == "pip install ." and train.volumes == {}
    assert train.file_mounts["/tmp/motionloom-recipe.yaml"] == str(recipe)
    assert isinstance(train.run, str) and "run /tmp/motionloom-recipe.yaml -o" in train.run


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["storage=v", "image=x"], "which GPUs"),
        (["storage=v", "accelerator=H100"], "come without motionloom"),
        (["storage=v", "accelerator=H100", "image=x", "mount=/other"], "would vanish with its machine"),
    ],
)
def test_what_skypilot_lacks_is_said(paper: Recipe, words: list[str], message: str) -> None:
    options = SkyPilotOptions.from_words(words)
    with pytest.raises(UserError, match=message):
        tasks(plan_of(paper, options), options)


# SLURM.


def scripts(paper: Recipe, folder: Path, *words: str, **changes: Any) -> list[slurm_run.Script]:
    options = SlurmOptions.from_words(words)
    plan = plan_of(paper, options, **changes)
    return slurm_run.slurm_scripts(plan, options, folder, folder)


def asked(script: slurm_run.Script) -> dict[str, str]:
    lines = [line for line in script.text.splitlines() if line.startswith("#SBATCH ")]
    pairs = [shlex.split(line.removeprefix("#SBATCH "))[0].partition("=") for line in lines]
    return {name.removeprefix("--"): value for name, _, value in pairs}


def test_scripts_ask_for_a_task_a_gpu(paper: Recipe, tmp_path: Path) -> None:
    first, train, last = scripts(paper, tmp_path, "partition=gpu", "light_partition=cpu", "extra.comment=a b")
    found = asked(train)
    assert {key: found[key] for key in ("nodes", "ntasks-per-node", "gpus-per-node", "cpus-per-task")} == {
        "nodes": "2",
        "ntasks-per-node": "8",
        "gpus-per-node": "8",
        "cpus-per-task": "8",
    }
    assert found["signal"] == "B:USR1@120" and found["kill-on-invalid-dep"] == "yes" and "requeue" in found
    assert found["comment"] == "a b" and found["open-mode"] == "append"
    assert [asked(script)["partition"] for script in (first, train, last)] == ["cpu", "gpu", "gpu"]
    assert "gpus-per-node" not in asked(first) and asked(last)["gpus-per-node"] == "1"
    line = next(line for line in train.text.splitlines() if line.startswith("srun"))
    words = shlex.split(line)
    assert words[-1] == "&" and after(words, "--set")[0] == NASTY
    assert {"--nodes=2", "--ntasks-per-node=8", "--gpus-per-node=8"} <= set(words)
    assert not any(line.startswith("srun") for line in first.text.splitlines())
    assert train.submit("17") == ["sbatch", "--parsable", "--dependency=afterok:17", str(train.path)]


def fake_sbatch(folder: Path, monkeypatch: Any, refuse: str = "") -> Path:
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


def test_jobs_are_submitted_one_behind_the_other(tmp_path: Path, monkeypatch: Any) -> None:
    record = fake_sbatch(tmp_path / "bin", monkeypatch)
    out, to = tmp_path / "run", console()
    recipe = tmp_path / "own.yaml"
    recipe.write_text("extends: humantomato-tiny\nname: own\n")
    launch_recipe(recipe, "slurm", gpus_per_node=1, out=out, console=to)
    calls = [line.split() for line in record.read_text().splitlines()]
    assert [words[2] for words in calls[1:]] == ["--dependency=afterok:1", "--dependency=afterok:2"]
    written = sorted(Path(words[-1]) for words in calls)
    assert all(path.is_file() and path.parent.parent == out / ".slurm" for path in written)
    resolved = load_recipe(written[0].parent / "recipe.yaml")
    assert resolved.name == "own" and all("recipe.yaml -o" in path.read_text() for path in written)
    assert "scancel 1 2 3" in said(to)


def test_a_refused_job_takes_those_before_with_it(tmp_path: Path, monkeypatch: Any) -> None:
    record = fake_sbatch(tmp_path / "bin", monkeypatch, refuse="2-train.sbatch")
    with pytest.raises(UserError, match=r"2-train.sbatch: no such partition"):
        launch_recipe("humantomato-tiny", "slurm", gpus_per_node=1, out=tmp_path / "run", console=console())
    assert record.read_text().splitlines()[-1] == "scancel 1"


def test_without_a_cluster_it_says_so(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match="no sbatch here"):
        launch_recipe("humantomato-tiny", "slurm", gpus_per_node=1, out=tmp_path / "run", console=console())
    assert not (tmp_path / "run").exists()


# The command.


@pytest.mark.parametrize(("engine", "options"), [("slurm", []), ("kubernetes", POD), ("skypilot", SKY)])
def test_a_dry_run_writes_nothing(
    engine: str, options: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    to = console()
    launch_recipe("humantomato-tiny", engine, gpus_per_node=1, options=options, dry_run=True, console=to)
    assert "2-train" in said(to) and "until evaluate" in " ".join(said(to).replace("- ", "").split())
    assert list(tmp_path.iterdir()) == []


def test_the_file_and_how_to_start_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("own.yaml").write_text("extends: humantomato-tiny\nname: own\n")
    to = console()
    launch_recipe("own.yaml", "skypilot", gpus_per_node=1, options=SKY, console=to)
    assert "sky jobs launch --name own own-skypilot.yaml" in said(to)
    train = SkyTask.model_validate(list(yaml.safe_load_all(Path("own-skypilot.yaml").read_text()))[2])
    mounted = train.file_mounts["/tmp/motionloom-recipe.yaml"]
    assert isinstance(mounted, str) and load_recipe(mounted).name == "own"


@pytest.mark.parametrize(
    ("engine", "more", "message"),
    [
        ("slrum", {}, "no such engine; did you mean 'slurm'"),
        ("slurm", {"file": Path("x.yaml")}, "--file is for Kubernetes"),
        ("kubernetes", {"options": POD, "file": Path()}, "is a folder"),
    ],
)
def test_mistakes_are_sentences(engine: str, more: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        launch_recipe("humantomato-tiny", engine, gpus_per_node=1, dry_run=True, console=console(), **more)


def test_another_recipes_folder_is_refused_before_anything_waits(tmp_path: Path) -> None:
    (tmp_path / "recipe.yaml").write_text("name: other\n")
    with pytest.raises(UserError, match="holds a run of recipe 'other'"):
        launch_recipe(
            "humantomato-tiny", "slurm", gpus_per_node=1, out=tmp_path, dry_run=True, console=console()
        )
