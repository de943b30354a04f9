"""`motionloom serve`: a model as a page and an API, until Ctrl-C."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
from rich.console import Console

from motionloom.datasets.audio.features import beats
from motionloom.pipeline.contract.generation import StreamingGenerator
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.shipped_models import model_folder, say_model
from motionloom.pipeline.serve.app import Site
from motionloom.pipeline.serve.requests import ServeConfig
from motionloom.pipeline.serve.server import listen, run_site
from motionloom.pipeline.serve.work import Worker


def serve(folder: Path, config: ServeConfig, *, device: str = "auto", console: Console) -> None:
    """Serve a run folder, an exported one or a model of the package; returns after Ctrl-C."""
    if not model_folder(folder).is_dir():
        MotionModel.from_pretrained(folder)  # says what is there instead
    with closing(listen(config)) as place:
        model = MotionModel.from_pretrained(folder, device=device)
        if (taken := say_model(folder)) is not None:
            console.print(taken, markup=False, highlight=False, soft_wrap=True)
        warm(model)
        worker, name = Worker(config.waiting), folder.resolve().name
        run_site(Site(model, config, worker, name), place, worker, name, console)


def warm(model: MotionModel) -> None:
    """Load what is loaded at the first use, so that the first request does not wait for it."""
    generator = model.bundle.generator
    if "text" in generator.modalities:
        caption = (model.examples(1) or ["a person stands"])[0]  # a known one: a note here would be nobody's
        if isinstance(generator, StreamingGenerator):
            next(model.stream(caption, seconds=1.0))
        else:
            model.generate([caption], seconds=1.0)
    if "audio" in generator.modalities:
        rate = 22_050
        clicks = (np.arange(4 * rate) % (rate // 2) < 100).astype(np.float32)
        beats(clicks, rate)
