"""The documents say what is so: commands parse, targets, links, recipes and Python examples exist."""

from __future__ import annotations

import ast
import importlib.util
import io
import re
import shlex
import tomllib
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer
import yaml
from program import commands as options_by_command
from rich.console import Console

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.convert.registry import converters
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.pipeline.cli.main import app
from motionloom.pipeline.contract.stage import stage_kinds
from motionloom.pipeline.inference.files.writers import WRITERS
from motionloom.pipeline.inference.script import Script
from motionloom.pipeline.inference.shipped_models import shipped_models
from motionloom.pipeline.runs.cluster.launch import launch_recipe
from motionloom.pipeline.runs.dry_run import estimate
from motionloom.pipeline.runs.layers import shipped_recipes
from motionloom.pipeline.runs.plan import make_plan
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.store.yaml import read_yaml

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md")]
DOCUMENTS += sorted((ROOT / "docs").glob("*.md"))
DOCUMENTS += sorted((ROOT / "models" / "pretrained").glob("*/README.md"))
DOCUMENTS += sorted((ROOT / "pipeline" / "baselines").glob("*/README.md"))
DOCUMENTS.append(ROOT / "pipeline" / "songs" / "README.md")
OTHER_PROGRAMS = {
    ".",
    "curl",
    "diff",
    "energon",
    "export",
    "hf",
    "module",
    "pip",
    "python",
    "pre-commit",
    "uv",
}
LAUNCHERS = {"srun", "torchrun"}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


class Block(NamedTuple):
    document: Path
    line: int
    language: str
    text: str


def blocks(*languages: str) -> list[Block]:
    """Fenced code blocks, also indented ones."""
    found = []
    for document in DOCUMENTS:
        text = document.read_text(encoding="utf-8")
        for match in re.finditer(r"^( *)```(\w*)\n(.*?)^\1```$", text, re.M | re.S):
            indent, language, body = match.groups()
            body = re.sub(f"^{indent}", "", body, flags=re.M)
            if language in languages:
                found.append(Block(document, text.count("\n", 0, match.start()) + 1, language, body))
    return found


def commands() -> Iterator[tuple[str, list[str]]]:
    """(where, words) of every command in a `sh` block; lines joined, chains and redirections cut."""
    for block in blocks("sh"):
        for line in re.sub(r"\\\n\s*", "", block.text).splitlines():
            words = shlex.split(line, comments=True)
            where = f"{block.document.name}:{block.line}: {line}"
            while words:
                end = words.index("&&") if "&&" in words else len(words)
                yield where, words[: words.index(">") if ">" in words[:end] else end]
                words = words[end + 1 :]


COMMANDS = list(commands())


def parsed(words: list[str]) -> dict[str, Any]:
    """Parameters of a `motionloom` command, read by the real command line; raises what a user would see."""
    command: Any = typer.main.get_command(app)
    words = words[1:]
    while hasattr(command, "list_commands"):
        assert words and words[0] in command.list_commands(None), f"no command {words[:1]}"
        command = command.get_command(None, words.pop(0))
    return dict(command.make_context(command.name, words).params) | {"command": command.name}


def need_weights(model: str) -> None:
    """A recipe that starts from a model of the package can be read where its weights are."""
    if not (ROOT / "models" / "pretrained" / model / "bundle.json").is_file():
        pytest.skip(f"this working copy has no weights of the model '{model}'")


def make_targets() -> set[str]:
    return set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))


@pytest.mark.parametrize(("where", "words"), COMMANDS, ids=[where for where, _ in COMMANDS])
def test_command_is_real(where: str, words: list[str]) -> None:
    if words[0] in LAUNCHERS:
        words = words[words.index("motionloom") :]
    program = words[0].removeprefix(".venv/bin/")
    if program == "motionloom":
        given = parsed(words)
        recipe = str(given.get("recipe", ""))
        if recipe == "finetune":
            need_weights(read_yaml(shipped_recipes()[recipe])["start"])
        if given["command"] == "run" and not recipe.endswith(".yaml"):
            load_recipe(recipe, given["sets"] or ())
        if given["command"] == "launch":
            dry = {key: given[key] for key in ("nodes", "gpus_per_node", "dry_run")}
            chosen = {"overrides": given["sets"] or (), "options": given["cluster"] or ()}
            assert given["dry_run"]
            launch_recipe(recipe, **dry, **chosen, console=Console(file=io.StringIO()))
    elif program == "make":
        targets = [word for word in words[1:] if "=" not in word]
        assert targets and set(targets) <= make_targets(), where
    else:
        assert program in OTHER_PROGRAMS, where


def test_extras_exist() -> None:
    known = set(PROJECT["optional-dependencies"])
    for where, words in COMMANDS:
        if "pip" in words[:2]:
            for extras in re.findall(r"\[([\w,-]+)\]", " ".join(words)):
                assert set(extras.split(",")) <= known, where


def test_the_workflow_runs_real_commands() -> None:
    workflow = yaml.safe_load((ROOT / "docs" / "workflow.yml").read_text(encoding="utf-8"))
    (job,) = workflow["jobs"].values()
    text = "\n".join(step["run"] for step in job["steps"] if "run" in step)
    lines = [line.strip() for line in re.sub(r"\\\n\s*", "", text).splitlines()]
    given = [parsed(shlex.split(line)) for line in lines if line.startswith("motionloom ")]
    (run,) = [one for one in given if one["command"] == "run"]
    assert load_recipe(ROOT / "docs" / str(run["recipe"])).stages
    assert {"check", "synth"} <= {one["command"] for one in given}


def test_inline_make_targets_exist() -> None:
    for document in DOCUMENTS:
        for code in re.findall(r"`make ([^`]+)`", document.read_text(encoding="utf-8")):
            targets = [word for word in shlex.split(code) if "=" not in word]
            assert set(targets) <= make_targets(), f"{document.name}: make {code}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: p.name)
def test_links_and_pictures_exist(document: Path) -> None:
    text = re.sub(r"^ *```.*?^ *```$", "", document.read_text(encoding="utf-8"), flags=re.M | re.S)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        path = (document.parent / name).resolve() if name else document
        assert path.is_relative_to(ROOT) and path.exists(), f"{document.name}: {target} does not exist"
        if anchor:
            assert anchor in anchors(path), f"{document.name}: {path.name} has no heading #{anchor}"


def anchors(document: Path) -> set[str]:
    """Headings as GitHub names them."""
    headings = re.findall(r"^#+ (.+)$", document.read_text(encoding="utf-8"), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("block", blocks("python"), ids=lambda b: f"{b.document.name}:{b.line}")
def test_python_example_compiles_and_imports(block: Block) -> None:
    for node in ast.walk(ast.parse(block.text)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                importlib.import_module(alias.name)
        elif isinstance(node, ast.ImportFrom):
            module = importlib.import_module(str(node.module))
            for alias in node.names:
                assert hasattr(module, alias.name), f"{node.module} has no {alias.name}"


def test_the_blocks_of_the_librarys_page_run_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    page = ROOT / "docs" / "library.md"
    text = page.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    names: dict[str, object] = {"__name__": "library"}
    for block in re.findall(r"^```python\n(.*?)^```$", text, re.M | re.S):
        exec(compile(block, str(page), "exec"), names)
    best = names["best"]
    assert Path(best.best_model_path).is_file()  # type: ignore[attr-defined]
    assert names["trainer"].callback_metrics["val/loss"].isfinite()  # type: ignore[attr-defined]


@pytest.mark.parametrize("block", blocks("yaml"), ids=lambda b: f"{b.document.name}:{b.line}")
def test_yaml_example_is_a_recipe_or_a_script(block: Block, tmp_path: Path) -> None:
    data = yaml.safe_load(block.text)
    if "jobs" in data or "stages" not in data:  # a workflow of a CI service, or a piece of a recipe
        return
    if "segments" in data:
        assert Script.parse(data, "example").segments
        return
    path = tmp_path / "recipe.yaml"
    path.write_text(block.text, encoding="utf-8")
    if "start" in data:
        need_weights(data["start"])
    assert load_recipe(path).name == data["name"]


def test_widths_of_layouts_are_true() -> None:
    data = (ROOT / "docs" / "data.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (\d+) \|", data, re.M)
    assert rows and all(MotionLayout.named(name).dim == int(width) for name, width in rows)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: p.name)
def test_named_files_are_of_the_repository_and_exist(document: Path) -> None:
    # The limits of volume may name a room that has gone.
    text = re.sub(r"<!-- house -->.*<!-- /house -->", "", document.read_text(encoding="utf-8"), flags=re.S)
    for name in re.findall(r"`((?:datasets|models|pipeline|configs|tests|docs)/[\w./-]*)`", text):
        assert (ROOT / name).exists(), f"{document.name}: {name} does not exist"
    assert not re.findall(r"(?:^|[\s`\"'(=:])(?:/(?!/)[A-Za-z][\w.-]*/\S*|~/\S+|[A-Z]:\\\S+)", text, re.M)


def test_the_readme_says_what_the_models_of_the_package_know() -> None:
    text = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    for name, model in shipped_models().items():
        _, _, known = model.description.partition("it knows ")
        assert known and known in text, f"{name} knows {known}"


# Options, commands, settings, recipes and memory that a page, a message or a help text names are there.

PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "models/pretrained").glob("*/*.md")]
SOURCES = [path for room in ("datasets", "models", "pipeline") for path in (ROOT / room).rglob("*.py")]
OF_SLURM = "cpus-per-task dependency gpus-per-node gpus-per-task jobs kill-on-bad-exit kill-on-invalid-dep"
OF_MORE = "exclude max-restarts rdzv-backend filename yes"
OTHERS = (
    f"{OF_SLURM} {OF_MORE} nodes noheader ntasks-per-node parsable requeue extra-index-url torch-backend help"
)
ADVISED = {
    " ".join(words): {"--help", *(option for each in command.params for option in each.opts)}
    for words, command in options_by_command()
}
OPTIONS = {"--version", *(f"--{name}" for name in OTHERS.split())}.union(*ADVISED.values())


def configs(base: type[Config]) -> Iterator[type[Config]]:
    """Every config that there is."""
    for kind in base.__subclasses__():
        yield from (kind, *configs(kind))


assert converters() and list(stage_kinds().values())
for module in (
    "serve.requests",
    "editing.task",
    "inference.files.display_figure",
    "runs.cluster.launch_plan",
):
    import_module(f"motionloom.pipeline.{module}")
SETTINGS = {"face", "seed_motion", "seed", "kind", "extends", "start"}.union(
    *(kind.model_fields for kind in configs(Config)), *(writer.options for writer in WRITERS.values())
)


def text_of(path: Path) -> str:
    """The strings of a source; of a page all but comments and fenced blocks, which other tests read."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        return re.sub(r"^( *)```.*?^\1```$|<!--.*?-->", "", text, flags=re.M | re.S)
    found = [node.value for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Constant)]
    return "\n\n".join(value for value in found if isinstance(value, str))


def settings_in(code: str) -> Iterator[str]:
    """Keys that an inline code sets, by `key=value` or YAML; a keyword argument of Python is none."""
    if found := re.fullmatch(r"([a-z_.]+)=(?!True|False|\").+", code):
        yield found[1]
    if re.fullmatch(r"[a-z_.]+: [^ ].*", code):
        [(key, value)] = yaml.safe_load(code).items()
        yield from value if isinstance(value, dict) else [key]


@pytest.mark.parametrize("path", [*PAGES, *SOURCES], ids=lambda path: str(path.relative_to(ROOT)))
def test_what_a_text_names_can_be_given(path: Path) -> None:
    text, known = text_of(path), set(OPTIONS)
    keys = re.findall(r"--set '?([a-z_]+(?:\.[a-z_]+)*)=", text)
    keys += re.findall(r"(?<![\w./-])(?:hardware|train|optim)\.[a-z_]+\b(?!\.)(?<!\.txt)(?<!\.frames)", text)
    for code in (" ".join(code.split()) for code in re.findall(r"(?<!`)`([^`]+)`(?!`)", text)):
        if script := re.search(r"benchmarks/\w+\.py", code):
            code = "".join((ROOT / one).read_text() for one in (script[0], "benchmarks/bench.py"))
            known |= set(re.findall(r'"(--[a-z-]+)"', code))
            continue
        named = re.sub(r"convert ((?=--)|[A-Z…][A-Z…-]*)", "convert bvh ", code.removeprefix("motionloom "))
        own = [options for words, options in ADVISED.items() if f"{named} ".startswith(f"{words} ")]
        whole = re.match(r"motionloom [a-z]+ [^-…]", code) is not None
        assert own or not whole or "arrays" in code, f"no command {code}"
        if own:
            assert {word for word in named.split() if re.match("--[a-z]", word)} <= own[0], code
        if path.suffix == ".md" and path.name != "SECURITY.md":
            keys += settings_in(code)
    for rows in re.findall(r"^\|[^|]*\bkey \|.*\n\|.*\n((?:\|.*\n)+)", text, re.M):
        keys += [key for row in rows.splitlines() for key in re.findall(r"`([a-z_.]+)`", row.split("|")[1])]
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]+\b", text)) <= known
    unknown = {key for key in keys if not SETTINGS.issuperset(key.split(".")[1:] or [key])}
    assert unknown <= {"stage.field", "tokenizer", "train.epochs", "defaults.trained.train.clips"}
    recipes = re.findall(r"\b(?:humantomato|ude|baselines|t2m-gpt)-[a-z][a-z0-9-]*[a-z0-9]\b(?![./])", text)
    assert set(recipes) <= set(shipped_recipes())


@pytest.mark.parametrize("name", shipped_recipes())
def test_the_setting_for_a_folder_that_is_not_there_is_of_its_stage(name: str, tmp_path: Path) -> None:
    recipe = load_recipe(name)
    first = recipe.stages[0]
    if first.kind.name in {"shards", *(kind.name for kind in converters())}:
        with pytest.raises(UserError, match=rf"--set {first.name}\.(path|source)=FOLDER"):
            make_plan(recipe, tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["humantomato-paper", "ude-paper"])
def test_the_readme_says_the_memory_that_a_dry_run_says(name: str) -> None:
    text = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    said = re.findall(r"(?:in bf16:|TMA needs|the tokenizers) ([\d.]*\d)", text)
    largest, tma, tokenizer = map(float, said)
    cards = {stage: card.memory_bytes / 2**30 for stage, card in estimate(load_recipe(name)).items()}
    assert cards["tma"] == pytest.approx(tma, rel=0.03)
    assert max(cards.values()) <= largest + 0.1 and cards["tokenizer"] <= tokenizer + 0.1
