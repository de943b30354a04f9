"""Report stage: one self-contained page with motions to watch, figures, curves and codebooks."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from pydantic import Field

from motionloom.datasets.motion.features import decode
from motionloom.pipeline.evaluation.truth import (
    Truth,
    joint_layout,
    reconstruct,
    reconstruct_truth,
    spread,
    truth_of,
)
from motionloom.pipeline.inference.bundle import Bundle, GeneratedMotion, text_encoder_of
from motionloom.pipeline.inference.faces import GptFace
from motionloom.pipeline.inference.sampling import SamplingConfig
from motionloom.pipeline.render.charts import Line
from motionloom.pipeline.render.face import synthetic_face_controls
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.render.viewer import ViewerMotion
from motionloom.pipeline.stages.evaluate import figure_rows
from motionloom.pipeline.stages.stage import StageConfig, StageContext
from motionloom.pipeline.stages.training import read_metrics
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.data import held_out, open_split
from motionloom.pipeline.store.tokens import TokenStore


class ReportConfig(StageConfig):
    """What the page shows."""

    count: int = Field(6, ge=1, le=24)
    """Held-out clips shown as truth, reconstruction and generation."""
    sampling: SamplingConfig = SamplingConfig()


def run_report(context: StageContext) -> None:
    """Write `report.html`."""
    bundle = Bundle.from_parts(dict(context.inputs), text_encoder_of(context.input("text")), context.device)
    data = context.input("data")
    split = held_out(data, prefer="test")
    dataset = open_split(data, split)
    truths = [truth_of(dataset, i) for i in spread(dataset, context.config.count)]
    generated = bundle.generate(
        [t.caption for t in truths],
        face_captions=[t.face_caption for t in truths],
        seed=context.seed,
        sampling=context.config.sampling,
    )
    # The recipe's name, not the folder's: equal runs write equal pages wherever they lie.
    page = Page(
        f"motionloom: {context.recipe}", f"{len(dataset)} clips of the {split} split were never trained on"
    )
    page.add_heading("Watch")
    page.add_viewer(
        _motions(bundle, truths, generated),
        "Each row is one caption: the recorded clip, what the tokenizer keeps of it, and a motion that the "
        "model made from the words alone. Drag to orbit, wheel to zoom, space to play.",
    )
    _figures(page, context.optional("evaluate"))
    _curves(page, context)
    _codebooks(page, context, bundle)
    page.write(context.folder / "report.html")


def _motions(bundle: Bundle, truths: list[Truth], generated: list[GeneratedMotion]) -> list[ViewerMotion]:
    layout = joint_layout(bundle.layout)
    parents, out = layout.skeleton.parents, []
    for number, (truth, made) in enumerate(zip(truths, generated, strict=True), start=1):
        group = f"{number}"
        same = truth.face_caption == truth.caption
        words = truth.caption if same else f"{truth.caption} (face: {truth.face_caption})"
        face = None if truth.face is None else synthetic_face_controls(truth.face)
        again = face
        face_tokens = bundle.faces.get("gpt")
        if truth.face is not None and isinstance(face_tokens, GptFace):
            again = synthetic_face_controls(reconstruct(face_tokens.tokenizer, bundle.stats, truth.face))
        rebuilt = decode(reconstruct_truth(bundle.tokenizer, bundle.stats, truth), layout)
        for label, joints, controls in (
            ("recorded", truth.joints, face),
            ("reconstruction", rebuilt, again),
            ("generated", made.joints, None if made.face is None else synthetic_face_controls(made.face)),
        ):
            out.append(ViewerMotion(joints, layout.fps, parents, label, words, group, controls))
    return out


def _figures(page: Page, folder: Path | None) -> None:
    if folder is None:
        return
    figures = json.loads((folder / "metrics.json").read_text())
    page.add_heading("Figures on held-out clips")
    for title, columns, rows in figure_rows(figures):
        page.add_table(columns, [list(row) for row in rows], title)


def _curves(page: Page, context: StageContext) -> None:
    page.add_heading("Training")
    books = ("recon", "perplexity", "usage", "dead", "resets")
    wanted = {
        "tokenizer": books,
        "face_tokenizer": books,
        "tma": ("contrastive", "loss"),
        "gpt": ("ce", "accuracy"),
        "face_gpt": ("ce",),
    }
    for role, prefixes in wanted.items():
        folder = context.optional(role)
        if folder is None:
            continue
        rows = read_metrics(folder)
        keys = sorted({k.partition("/")[2] for row in rows for k in row if "/" in k})
        for prefix in prefixes:
            lines = [line for key in keys if key.startswith(prefix) for line in _lines(rows, key)]
            if lines:
                page.add_plot(lines, f"{role}: {prefix}")


def _lines(rows: list[dict[str, float]], key: str) -> list[Line]:
    out = []
    for kind, dashed in (("train", False), ("val", True)):
        points = [(row["step"], row[f"{kind}/{key}"]) for row in rows if f"{kind}/{key}" in row]
        if points:
            steps, values = zip(*points, strict=True)
            out.append(Line(f"{key} ({kind})", steps, values, dashed))
    return out


def _codebooks(page: Page, context: StageContext, bundle: Bundle) -> None:
    tokens = context.inputs["gpt"].parent / _tokens_stage(context.inputs["gpt"])
    path = tokens / "tokens-train.safetensors"
    streams = bundle.tokenizer.streams
    store = TokenStore.load(path, {s.name: s.per_group for s in streams}).whole_clips()
    page.add_heading("Codebooks")
    for stream in streams:
        uses = np.bincount(store.codes[stream.name].numpy(), minlength=stream.num_codes)
        used = int((uses > 0).sum())
        title = f"{stream.name}: {used} of {stream.num_codes} codes used by the training clips"
        page.add_bars(np.sort(uses)[::-1], title, x_label="code, most used first", y_label="uses")


def _tokens_stage(gpt: Path) -> str:
    artifact = Artifact.find(gpt)
    assert artifact is not None
    return artifact.inputs["tokens"].stage
