"""Options, commands, settings, recipes and memory that a page, a message or a help text names are there."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest
import yaml
from program import commands

from motionloom.datasets.convert.registry import converters
from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.contract.stage import stage_kinds
from motionloom.pipeline.runs.dry_run import estimate
from motionloom.pipeline.runs.plan import make_plan
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.runs.resolve import shipped_recipes

ROOT = Path(__file__).resolve().parents[1]
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "models/pretrained").glob("*/*.md")]
SOURCES = [path for room in ("datasets", "models", "pipeline") for path in (ROOT / room).rglob("*.py")]
OF_SLURM = "cpus-per-task dependency gpus-per-node gpus-per-task jobs kill-on-bad-exit kill-on-invalid-dep"
OF_OTHERS = f"{OF_SLURM} nodes noheader ntasks-per-node parsable requeue extra-index-url torch-backend help"
COMMANDS = {
    " ".join(words): {"--help", *(option for each in command.params for option in each.opts)}
    for words, command in commands()
}
OPTIONS = {"--version", *(f"--{name}" for name in OF_OTHERS.split())}.union(*COMMANDS.values())


def configs(base: type[Config]) -> Iterator[type[Config]]:
    """Every config that there is."""
    for kind in base.__subclasses__():
        yield from (kind, *configs(kind))


assert converters() and stage_kinds()
for module in ("serve.requests", "contract.editing", "inference.shown", "runs.launch_plan"):
    import_module(f"motionloom.pipeline.{module}")
SETTINGS = {"face", "seed_motion", "seed", "kind", "extends", "start"}.union(
    *(kind.model_fields for kind in configs(Config))
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
        own = [options for words, options in COMMANDS.items() if f"{named} ".startswith(f"{words} ")]
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
    assert unknown <= {"stage.field", "tokenizer"}  # any stage
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
