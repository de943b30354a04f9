"""Measure what a model of synthetic clips knows: the card of its exported folder, and its figures again.

    motionloom run humantomato-synthetic
    motionloom export runs/humantomato-synthetic -o model --half --set cfg_scale=1.5
    python benchmarks/model_card.py model --write

The test clips are made here, from the data settings and the seed of the recipe, so nothing is needed but the
model. Motions are generated for the clips' captions, once as they are worded in training and once in other
words (`synthetic_wordings.json` beside this script: sentences that the captions of synthetic clips never
make), and measured on their joints and expressions: does the motion do what the caption says? "Held out" are
combinations of words that training never showed. Beside them stands another clip's motion, which is what a
guess gets. The other words were written before the model was first measured on them.

With `--write`: `README.md` (the card) and `card.json` (the figures) into the model's folder. Without, what
the card says is measured again, by the settings that stand there, and compared. A model that comes with the
package:

    python benchmarks/model_card.py synthetic
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from bench import Shares, judge, made_by, making, markdown, shown
from results import read_records
from rich.console import Console
from rich.table import Table

from motionloom.datasets.actions.hands import HANDS
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.expressions import FACES
from motionloom.datasets.motion.features.codec import face_of
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.synth.actions.truth import takes_part
from motionloom.datasets.synth.generate import SynthConfig, captions_of, make_sample, split_of, truth_of
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.evaluation.figures import NEAREST_LABELS, NEAREST_WORDS
from motionloom.pipeline.evaluation.reference_baselines import most_similar, nearest_texts
from motionloom.pipeline.evaluation.truth import Truth
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.generation import generate
from motionloom.pipeline.inference.request import Request
from motionloom.pipeline.inference.shipped_models import CARD_FIGURES, model_folder
from motionloom.pipeline.runs.recipe import Recipe, load_recipe

RECIPE = "humantomato-synthetic"
KINDS = ("held out", "other")

WORDS = Path(__file__).with_name("synthetic_wordings.json")
FAMILIAR = "as in training"
OTHER = "other words"
GUESS = "another clip's motion"

ASKED = 60
"""Clips whose captions are asked about."""

CARD = Path(__file__).with_suffix(".md")


def words_of(truth: Mapping[str, Any], words: Mapping[str, Any], rng: np.random.Generator) -> tuple[str, str]:
    """A caption of the body and one of the face, in other words."""

    def pick(choices: Sequence[str]) -> str:
        return choices[int(rng.integers(len(choices)))]

    body = " and next ".join(_said(part, words, pick) for part in truth.get("parts", [truth]))
    shapes = {hand: truth.get(f"{hand}_hand", "relaxed") for hand in ("left", "right")}
    hands = [
        pick(words["hands"][shape]).format(h=f"the {hand} hand")
        for hand, shape in shapes.items()
        if shape != "relaxed" and not takes_part(truth["action"], truth.get("side"), hand)
    ]
    face = pick(words["faces"][truth["face"]]) if truth.get("face") else ""
    who = pick(words["who"])
    return ", ".join([f"{who} {body}", *hands]), f"{who} {face}" if face else ""


def _said(truth: Mapping[str, Any], words: Mapping[str, Any], pick: Callable[[Sequence[str]], str]) -> str:
    """One action in other words."""
    style = truth.get("style") if truth["action"] == "turn" else None
    said = pick(
        words["actions"][" ".join(part for part in (truth["action"], truth.get("direction"), style) if part)]
    )
    count = truth.get("count")
    speed = truth.get("speed")
    side = truth.get("side")
    limb = {"wave": "hand", "raise": "arm"}.get(truth["action"])
    named = f"both {limb}s" if side == "both" else f"the {side} {limb}" if limb else side
    return said.format(
        s=named,
        n=pick(words["times"][str(count)]) if count else "",
        v=pick(words["speed"][speed]) if speed else "",
        b=truth.get("bpm"),
    )


def columns_of(shares: Mapping[str, Shares]) -> list[tuple[str, str]]:
    """(row of `shares`, kind of clips): held out and other ones of the model, held-out ones of the rest."""
    return [(title, kind) for title in shares for kind in KINDS[: 2 if title in (FAMILIAR, OTHER) else 1]]


def rows_of(shares: Mapping[str, Shares]) -> list[list[str]]:
    """Attribute, then its share of right clips in each column, in percent."""
    names = sorted({name for share in shares.values() for row in share.values() for name in row})
    last = [name for name in ("shape", "every", "whole") if name in names]
    names = [name for name in names if name not in last] + last
    cells = [shares[title][kind] for title, kind in columns_of(shares)]
    return [[name, *(f"{100 * cell[name]:.1f}" if name in cell else "" for cell in cells)] for name in names]


def synthetic_data(recipe: Recipe) -> list[SynthConfig]:
    """Return the settings of a recipe's stages of synthetic clips."""
    out = []
    for stage in recipe.stages:
        if stage.kind.name == "synth":
            given = stage.config.dump()
            seed = recipe.seed if given["seed"] is None else given["seed"]
            out.append(SynthConfig.parse({**given, "seed": seed}, recipe.name))
    if not out:
        raise UserError(f"{recipe.name}: has no stage of synthetic clips to be measured on")
    return out


def test_clips(recipe: Recipe, most: int) -> tuple[list[Truth], SynthConfig]:
    """Test clips of a recipe's synthetic data in a fixed order, at most so many, as its shards hold them; and
    the data's settings."""
    config = synthetic_data(recipe)[0]
    numbers = [index for index in range(config.clips) if split_of(index, config) == "test"]
    chosen = [numbers[k] for k in np.random.default_rng(0).permutation(len(numbers))[:most]]
    return [truth_from(make_sample(index, config), config) for index in chosen], config


def truth_from(sample: Sample, config: SynthConfig) -> Truth:
    """One clip with its first captions, cut to whole groups of four frames."""
    layout = config.motion_layout
    motion = np.asarray(sample.motion, dtype=np.float32)
    motion = motion[: len(motion) // 4 * 4]
    body = motion[:, layout.part("bodyhand")]
    caption = sample.texts[0].text if sample.texts else ""
    return Truth(
        id=sample.meta.id,
        features=body,
        joints=joints_of(body, layout),
        face=face_of(motion, layout) if layout.has("face") else None,
        caption=caption,
        face_caption=sample.face_texts[0].text if sample.face_texts else caption,
        truth=sample.meta.truth,
    )


def lookups(truths: Sequence[Truth], config: SynthConfig) -> dict[str, list[Truth]]:
    """The training clips that know the labels best, and those whose first caption is nearest: no model."""
    train = [index for index in range(config.clips) if split_of(index, config) == "train"]
    plans = {index: truth_of(index, config) for index in train}
    texts = [captions_of(k, config)[0][0] for k in train]
    found = {
        NEAREST_LABELS: most_similar(
            [plans[k].record(hands=True, face=True) for k in train], [t.truth or {} for t in truths]
        ),
        NEAREST_WORDS: nearest_texts(texts, [t.caption for t in truths]),
    }
    clips = {k: truth_from(make_sample(train[k], config), config) for row in found.values() for k in {*row}}
    return {title: [clips[k] for k in row] for title, row in found.items()}


def noted(model: Path) -> dict[str, Any]:
    """The figures of the card beside a model; empty where there is none."""
    path = model / CARD_FIGURES
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", type=Path, help="an exported folder, or the name of a model of the package")
    parser.add_argument("--write", action="store_true", help="write the card into the model's folder")
    parser.add_argument(
        "--run", type=Path, help="the run that it was exported from, whose days and steps the card notes"
    )
    parser.add_argument("--recipe", help=f"what it was made by; default: as the card says, or {RECIPE}")
    parser.add_argument(
        "--set", action="append", help="a setting of the recipe, as for `run`; default: as the card says"
    )
    parser.add_argument("--name", help="what the card calls it; default: the folder's name, or the card's")
    parser.add_argument("--clips", type=int, help="test clips, at most; default: as the card says, or all")
    parser.add_argument("--seed", type=int, help="default: as the card says, or 0")
    args = parser.parse_args()
    model = model_folder(args.model)
    console = Console()
    before = noted(model)
    settings = before.get("settings", []) if args.set is None else args.set
    recipe = load_recipe(args.recipe or before.get("recipe", RECIPE), settings, strict=False)
    most = args.clips or before.get("clips", 1_000_000)
    seed = before.get("seed", 0) if args.seed is None else args.seed
    words = json.loads(WORDS.read_text(encoding="utf-8"))
    truths, data = test_clips(recipe, most)
    rng = np.random.default_rng(seed)
    try:
        other = [words_of(truth.truth or {}, words, rng) for truth in truths]
    except KeyError as error:
        raise UserError(f"{WORDS.name} has no other words for {error}") from None
    bundle = Bundle.open(model)
    sampling = bundle.drawing(SamplingConfig.of(before.get("sampling")))
    said = {
        FAMILIAR: ([t.caption for t in truths], [t.face_caption for t in truths]),
        OTHER: ([body for body, _ in other], [face or body for body, face in other]),
    }
    order = np.random.default_rng(0).permutation(len(truths))
    fps = bundle.layout.fps
    hold_out = data.hold_out

    def measured(how: SamplingConfig) -> dict[str, Shares]:
        out = {}
        for title, (captions, faces) in said.items():
            made = generate(bundle, Request.of(captions, face=faces, sampling=how, seed=seed))
            out[title] = judge(truths, ((motion.joints, motion.face) for motion in made), fps, hold_out)
        return out

    shares = {GUESS: judge(truths, ((truths[k].joints, truths[k].face) for k in order), fps, hold_out)}
    for title, clips in lookups(truths, data).items():
        shares[title] = judge(truths, ((clip.joints, clip.face) for clip in clips), fps, hold_out)
    shares |= measured(sampling)
    single = measured(sampling.model_copy(update={"candidates": 1})) if sampling.candidates > 1 else {}
    table = Table("right, %", *(f"{title}: {kind}" for title, kind in columns_of(shares)))
    for row in rows_of(shares):
        table.add_row(*row)
    console.print(table)
    figures = {
        "name": args.name or before.get("name", args.model.resolve().name),
        "description": f"{recipe.description}; it knows {known(data)}",
        "recipe": args.recipe or before.get("recipe", RECIPE),
        "settings": settings,
        "clips": len(truths),
        "apart": sum(apart(truth, hold_out) for truth in truths),
        "sampling": sampling.model_dump(mode="json", exclude_unset=True),
        "seed": seed,
        "faults": before.get("faults", ""),
        "made": making(args.run) if args.run else before.get("made", {}),
        "right": shares,
        "single draws": single,
        "unknown": {
            **{
                title: len(bundle.unknown_captions(captions[:ASKED])) for title, (captions, _) in said.items()
            },
            "captions": min(ASKED, len(truths)),
        },
    }
    if args.write:
        (model / CARD_FIGURES).write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
        card = card_of(figures, recipe, data, bundle, model)
        (model / "README.md").write_text(card, encoding="utf-8")
        console.print(str(model / "README.md"), soft_wrap=True)
    else:
        console.print(compared(before, figures), soft_wrap=True)


def known(data: SynthConfig) -> str:
    """The actions in words; "then" is none of its own."""
    names = [name for name in data.action_names if name != "then"]
    return ", ".join(names) + (", and two in turn" if "then" in data.action_names else "")


def apart(truth: Truth, hold_out: Sequence[Mapping[str, Any]]) -> bool:
    """Whether a clip is of a combination that training never showed."""
    record = truth.truth or {}
    return any(all(record.get(key) == value for key, value in one.items()) for one in hold_out)


def compared(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """One line: how far the figures are from those of the card."""
    if not before:
        return "no card here to compare with; --write makes one"
    if any(before.get(key) != now.get(key) for key in ("clips", "seed", "sampling", "recipe", "settings")):
        return "not comparable with the card: other clips, seed, sampling, recipe or settings"
    gaps = {
        f"{name}, {title}, {kind}": 100 * abs(value - before["right"][title][kind][name])
        for title, kinds in now["right"].items()
        if title in before["right"]
        for kind, row in kinds.items()
        for name, value in row.items()
    }
    worst = max(gaps, key=lambda where: gaps[where])
    if gaps[worst] == 0:
        return f"all {len(gaps)} shares as on the card"
    return f"{len(gaps)} shares, at most {gaps[worst]:.1f} points from the card ({worst})"


def choice(sampling: Mapping[str, Any]) -> str:
    """How a motion is chosen, where it is."""
    count = sampling.get("candidates", 1)
    if count == 1:
        return ""
    return f" Of {count} draws TMA takes the nearest to the caption; it judges nothing here."


def single_draws(single: Mapping[str, Shares]) -> str:
    """A sentence on the first draw, where TMA chooses among several."""
    if not single:
        return ""
    rows = [
        f"{title} {100 * kinds['held out']['every']:.1f} and {100 * kinds['held out']['whole']:.1f} %"
        for title, kinds in single.items()
    ]
    return f" Of the first draw alone, `every` and `whole` of held-out clips are: {'; '.join(rows)}."


def music_section() -> str:
    """How its dances follow real songs, from the records of `benchmarks/real_songs.py`."""
    record = read_records()["real_songs"]
    row = record["rows"][0]
    columns = {column["figure"]: column for column in record["columns"]}
    own, shifted = (shown(row["cells"][name], columns[name]) for name in ("own", "shifted"))
    return (
        f"On {row['protocol']['songs']} real songs the dances' Beat Align is {own}, and {shifted} for beats "
        "shifted in time: [dances to music](../../../docs/results.md#dances-to-music-ude).\n\n"
    )


def card_of(
    figures: Mapping[str, Any], recipe: Recipe, data: SynthConfig, bundle: Bundle, model: Path
) -> str:
    """The card as Markdown."""
    shares = figures["right"]
    strange = figures["unknown"]
    sampling = figures["sampling"]
    head = ["right, %", *(f"{title}: {kind}" for title, kind in columns_of(shares))]
    size = sum(path.stat().st_size for path in model.rglob("*") if path.is_file()) / 1e6
    options = "".join(
        f" --set {name}" + (f".{key}={part}" if key else f"={part}")
        for name, value in sampling.items()
        for key, part in (value.items() if isinstance(value, dict) else [("", value)])
    )
    recommended = bundle.recommended.model_dump(mode="json", exclude_unset=True)
    recipe_file = figures["recipe"]
    settings = "".join(f" --set '{one}'" for one in figures["settings"])
    heard = "audio" in bundle.generator.modalities
    words = '"a person waves with the left hand"'
    uses = [f'{words} --set face="a person looks happy"' if bundle.faces else words]
    uses = ["--audio song.mp3", f"{words} --audio song.mp3@0:30-1:00", *uses] if heard else uses
    asked = "" if sampling == recommended else options
    return CARD.read_text(encoding="utf-8").format(
        examples_of_use="\n".join(f"motionloom generate {figures['name']} {use}{asked}" for use in uses),
        songs=" and dances to songs that FluidSynth played" if heard else "",
        or_music=" and no recorded music" if heard else "",
        music=music_section() if heard else "",
        name=figures["name"],
        description=recipe.description,
        sampling=", ".join(f"{name} {value}" for name, value in sampling.items()) or "the defaults",
        fps=bundle.layout.fps,
        bytes=size,
        clips=f"{sum(split_of(k, data) == 'train' for k in range(data.clips)):,}",
        actions="Actions: " + known(data),
        hands=", ".join(data.hand_shapes or HANDS[1:]),
        faces=", ".join(FACES),
        count=figures["clips"],
        apart=figures["apart"],
        seed=figures["seed"],
        faults=f"{figures['faults']}\n\n" if figures["faults"] else "",
        table=markdown(head, rows_of(shares)),
        chosen=choice(sampling),
        single=single_draws(figures["single draws"]),
        unknown=f"Of the first {strange['captions']} clips it calls {strange[OTHER]} of these captions and "
        f"{strange[FAMILIAR]} of the usual unknown.",
        commands=f"motionloom run {recipe_file}{settings}\n"
        f"motionloom export runs/{recipe.name} -o {figures['name']} --half{options}\n"
        f"python benchmarks/model_card.py {figures['name']} --recipe {recipe_file}{settings} "
        f"--run runs/{recipe.name} --write",
        made=made_by(figures["made"]),
        recipe_seed=recipe.seed,
    )


if __name__ == "__main__":
    main()
