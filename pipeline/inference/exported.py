"""Writing an export: the stages that it needs, each in a folder of its own, and `bundle.json`."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from itertools import chain, count
from pathlib import Path

from motionloom.datasets.base.files import write_text
from motionloom.datasets.base.register import code_of, distribution_of
from motionloom.datasets.shards.card import CARD_FILE, hub_card
from motionloom.pipeline.contract.lookup import FORMAT, BundleFile
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import CompletedStage
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.store.artifact import Artifact, InputStage, Terms, require_unchanged
from motionloom.pipeline.store.files import write_json
from motionloom.pipeline.store.run_folder import BUNDLE_FILE
from motionloom.pipeline.store.weights import LayoutFacts, halve_weights

HUB_CONFIG = {"format": "motionloom bundle"}
"""`config.json`, which the hub looks for; nothing here reads it."""


def write_bundle(
    run: Path, out: Path, *, half: bool = False, sampling: SamplingConfig | None = None
) -> Terms:
    """Copy what generation needs of a run's finished stages into `out`; with `half`, weights as 16 bits.

    What is set of `sampling` goes with the model: motions are drawn so where nobody says otherwise. Returns
    licences and credits of its data, which its card says.
    """
    bundle = Bundle.from_run(run)
    sampling = sampling or SamplingConfig()
    if bundle.stages:
        bundle.require_used(sampling)
    for stage in bundle.stages:
        bundle.generator_of(stage)  # opens every stage, so a broken one is found before anything is copied
    for stage in bundle.captioners:
        bundle.stage_cache.captioner(stage)
    out.mkdir(parents=True, exist_ok=True)
    _write_stages(bundle, out, half, sampling.model_dump(mode="json", exclude_unset=True))
    write_json(out / "config.json", HUB_CONFIG)
    write_text(out / CARD_FILE, _card(run.resolve().name, bundle.terms))
    return bundle.terms


def _card(name: str, terms: Terms) -> str:
    """The card of a model: its licence, where it comes from, and who is to be named."""
    facts = {
        "library_name": "motionloom",
        "pipeline_tag": "text-to-3d",
        "tags": ["human-motion", "text-to-motion", "whole-body"],
    }
    said = f"Its licence is the strictest of its data ({', '.join(terms.licences)})."
    return hub_card(name, terms.licence, facts, said, terms.credits)


def _write_stages(bundle: Bundle, out: Path, half: bool, sampling: dict[str, object]) -> None:
    """The folders of all stages that the bundle's need to load; `bundle.json` is written last.

    Stages of other runs come along like the run's own, so an export is whole in itself.
    """
    makers = bundle.stages
    captioners = bundle.captioners
    skeleton = bundle.layout.skeleton
    needed: dict[Path, CompletedStage] = {}
    for stage in (*makers, *captioners):
        _collect(stage, needed)
    names = _names(needed.values())
    (out / BUNDLE_FILE).unlink(missing_ok=True)
    made: dict[str, Artifact] = {}
    for folder, stage in needed.items():
        name = names[folder]
        artifact = Artifact.find(folder)
        assert artifact is not None
        require_unchanged(folder)
        try:
            stage.kind.export(stage, out / name)
            if half and (weights := out / name / "model.safetensors").is_file():
                halve_weights(weights)
        except BaseException:
            for copied in (*made, name):  # nothing that looks like a model is left
                shutil.rmtree(out / copied, ignore_errors=True)
            raise
        inputs = {
            role: InputStage(stage=names[source.folder], fingerprint=made[names[source.folder]].fingerprint)
            for role, source in stage.inputs.items()
            if role in stage.kind.exported(stage.config)
        }
        config = stage.kind.exported_config(stage.config).dump()
        changes = {"stage": name, "config": config, "inputs": inputs}
        made[name] = artifact.model_copy(update=changes).finish(out / name)
    write_json(
        out / "skeleton.json",
        {
            "name": skeleton.name,
            "joints": skeleton.joints,
            "parents": skeleton.parents,
            "offsets": skeleton.rest,
        },
    )
    modules = {name for stage in needed.values() for name in stage.kind.modules(stage.config)}
    facts = BundleFile(
        format=FORMAT,
        layout=LayoutFacts.of(bundle.layout),
        generators=tuple(names[stage.folder] for stage in makers),
        captioners=tuple(names[stage.folder] for stage in captioners),
        packages=tuple(sorted({distribution_of(name) for name in code_of(modules)})),
        sampling=sampling,
    )
    write_json(out / BUNDLE_FILE, facts.dump())


def _collect(stage: CompletedStage, needed: dict[Path, CompletedStage]) -> None:
    """Add a stage after those that it needs."""
    if stage.folder in needed:
        return
    for role in stage.kind.exported(stage.config):
        source = stage.inputs.get(role)
        if source is not None:
            _collect(source, needed)
    needed[stage.folder] = stage


def _names(stages: Iterable[CompletedStage]) -> dict[Path, str]:
    """A name for each stage: its own, with a number where one of another run finds its name taken."""
    out: dict[Path, str] = {}
    for stage in sorted(stages, key=lambda stage: stage.outside):
        own = stage.folder.name
        free = chain([own], (f"{own}-{number}" for number in count(2)))
        out[stage.folder] = next(name for name in free if name not in out.values())
    return out
