"""Units of an evaluation that processes share: clips reconstructed, captions performed, measured."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import HANDS
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import StageConfig, StageContext
from motionloom.pipeline.contract.units import Arrays, as_table, even_slices
from motionloom.pipeline.evaluation.clip_metrics import Performance, measure_clip, metrics_of
from motionloom.pipeline.evaluation.diagnosis import as_shown, joint_distances
from motionloom.pipeline.evaluation.judges import Judge
from motionloom.pipeline.evaluation.movement import all_features
from motionloom.pipeline.evaluation.reconstruction import clip_errors, expression_directions, face_errors
from motionloom.pipeline.evaluation.reference_baselines import NearestClip
from motionloom.pipeline.evaluation.truth import (
    Truth,
    drawn,
    has_caption,
    reconstruct_all,
    reconstruct_truth,
    recorded_seconds,
    spread_any,
    truth_of,
)
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.generation import generate
from motionloom.pipeline.inference.request import Request
from motionloom.pipeline.stages.results.evaluation import Evaluation, bundle_driven_by
from motionloom.pipeline.store.evaluator import LoadedEvaluator, embed_motions
from motionloom.pipeline.store.networks import TrainedTokenizer

_RECONSTRUCTED, _GENERATED = 16, 64
"""Clips at a time, at most."""
JOINTS, FACE, CLIP, MOVEMENT = "joints/", "face/", "clip/", "movement/"
"""Begin the names of what is measured of a clip."""
DISTANCES = "distances"
"""Errors of joints [n, N] of n clips."""
CAPTIONS = "texts.json"
"""The member of a clip that holds its captions."""
LATENT = {"tma": "latent", "evaluator": "latent_evaluator", "face_evaluator": "latent_face"}
"""Role of a judge -> name of its latents of what was generated or reconstructed."""


class EvaluateConfig(StageConfig):
    """Extent of the measurement."""

    clips: int | None = Field(400, ge=1)
    """At most this many clips of the test split; null takes all."""
    repeats: int = Field(20, ge=1)
    """Repetitions of generation and of drawing retrieval batches."""
    decodings: int = Field(1, ge=1)
    """Motions that a diffusion decoder makes of each repetition's tokens (UDE Tables 1 and 2: 30)."""
    size: int = Field(32, ge=2)
    """Candidates in retrieval by TMA (32: protocol D; 256: protocol C); an evaluator's are at most 32."""
    among: int = Field(61, ge=2)
    """Candidates of the accuracy of UDE's Table 1."""
    lengths: Literal["free", "recorded"] = "free"
    """How long generated motions are: as the generator decides, or as the recorded clip is (at most what the
    generator makes), which is all that VAEs and diffusion models can do."""
    sampling: SamplingConfig = SamplingConfig()
    face_model: Path | None = None
    """SMPL-X's or FLAME's model file of the user (.npz with `shapedirs`): with it v.-err. is measured."""

    @field_validator("sampling")
    @classmethod
    def _judged_by_others(cls, sampling: SamplingConfig) -> SamplingConfig:
        if sampling.candidates > 1:
            raise ValueError(
                "TMA would choose the motions that it then judges; leave candidates at 1 here, and measure "
                "chosen motions by what they do"
            )
        return sampling


class EvaluationUnits(Evaluation):
    """Results made clip by clip."""

    def __init__(self, context: StageContext) -> None:
        super().__init__(context)
        self.tokenizer: TrainedTokenizer | None = context.given.get("tokenizer")
        makers = context.every("generators")
        # Without generators a tokenizer alone is measured (`generators: []`).
        self.bundle: Bundle | None = None
        if makers:
            self.bundle = bundle_driven_by("text", makers, context.stage_cache) or Bundle(
                makers, context.stage_cache
            )
        self.judges = self._judges()
        if self.tokenizer is not None:
            unit = self.tokenizer.net.group_frames
        elif self.bundle is not None:
            unit = self.bundle.generator.unit_frames
        else:
            raise UserError(
                f"stage '{context.name}': no tokenizer and no generator to evaluate; name one in its inputs"
            )
        self.said = has_caption(self.dataset)
        chosen = drawn(self.dataset, self.config.clips) if self.said.any() else []
        self.truths = self._truths(chosen, unit)
        """Clips with a caption, which is performed."""
        self.shown: list[Truth] = []
        """Clips that are reconstructed."""
        if self.tokenizer is not None:
            every = self.said.all()
            self.shown = (
                self.truths if every else self._truths(spread_any(self.dataset, self.config.clips), unit)
            )

    def _judges(self) -> dict[str, Judge]:
        """The judges that are there, by role."""
        given = self.context.given
        if "evaluator" in given:
            found: LoadedEvaluator = given["evaluator"]
            found.require_layout(self.dataset.layout, self.context.inputs["evaluator"].name)
        return {role: Judge(given[role]) for role in LATENT if role in given}

    @cached_property
    def performed_by(self) -> dict[str, Judge]:
        """The judges of what the generators make."""
        makes_faces = self.bundle is not None and (
            bool(self.bundle.faces) or self.bundle.generator.part == "all"
        )
        return {
            role: judge
            for role, judge in self.judges.items()
            if not judge.of_faces or (makes_faces and judge.judged(self.truths))
        }

    @property
    def performs(self) -> bool:
        """Whether motions are made for captions."""
        bundle = self.bundle
        return bool(self.truths) and bundle is not None and "text" in bundle.generator.modalities

    @cached_property
    def slices(self) -> list[slice]:
        """Clips that are reconstructed together."""
        return even_slices(len(self.shown), _RECONSTRUCTED)

    @cached_property
    def performances(self) -> list[tuple[int, slice]]:
        """Draws and clips whose captions are performed together."""
        return self.in_turn(even_slices(len(self.truths), _GENERATED) if self.performs else [])

    def share(self) -> None:
        """This process's share of all that is made clip by clip."""
        if self.performs and self.bundle is not None:
            self.drawn_as(self.bundle)
            for judge in self.performed_by.values():
                # Captions that it cannot read are refused before anything is made.
                judge.texts(judge.judged(self.truths))
        slices = self.slices
        pieces = self.performances
        self.make(
            "reconstructed",
            "reconstructing",
            [piece.stop - piece.start for piece in slices],
            lambda k: self.reconstruct(self.shown[slices[k]]),
        )
        self.make(
            "generated",
            "generating",
            [piece.stop - piece.start for _, piece in pieces],
            lambda k: self.perform(*pieces[k]),
        )
        if self.performs:
            self.make_reference(CAPTIONS)

    def _truths(self, chosen: Sequence[int], unit: int) -> list[Truth]:
        """The clips `chosen` that are long enough for one group of tokens."""
        found = [truth_of(self.dataset, i) for i in sorted(chosen)]
        return [truth for truth in found if len(truth.features) >= unit]

    @cached_property
    def _nearest(self) -> NearestClip:
        return NearestClip(self.train)

    @cached_property
    def _directions(self) -> NDArray[np.float64] | None:
        path = self.config.face_model
        return None if path is None else expression_directions(path.expanduser())

    def reconstruct(self, truths: Sequence[Truth]) -> Arrays:
        """Errors of clips and faces through the tokenizer, and whether they still do what is said."""
        tokenizer = self.tokenizer
        assert tokenizer is not None
        bodies = [reconstruct_truth(tokenizer, truth) for truth in truths]
        pairs = list(zip(truths, bodies, strict=True))
        nearest = self._nearest.motions(truths)
        errors = [clip_errors(tokenizer, near, *pair) for near, pair in zip(nearest, pairs, strict=True)]
        out = as_table(errors, JOINTS)
        fps = self.dataset.layout.fps
        layout = tokenizer.layout
        shown = [Performance(joints_of(body, layout), t.joints, fps, t.face, t.truth) for t, body in pairs]
        out |= as_table([measure_clip(metrics_of("captions"), one) for one in shown], CLIP)
        out[DISTANCES] = np.stack([joint_distances(one.joints, one.recorded) for one in shown])
        # Hands that were never recorded are no truth to be compared with.
        out[DISTANCES][[not t.present & HANDS for t in truths], BODY_JOINTS:] = np.nan
        out |= as_shown(shown)
        faces = self.context.given.get("face_tokenizer", tokenizer)
        models_faces = faces.layout.has("face") and faces.net.part in ("face", "all")
        if models_faces:
            out |= as_table([face_errors(faces, t, self._directions) for t in truths], FACE)
        for role, judge in self.judges.items():
            some = judge.judged(truths)
            if not judge.of_faces:
                made = bodies
            elif models_faces:
                made = [reconstruct_all(faces, t)[:, faces.layout.slice("face")] for t in some]
            else:
                continue
            if made:
                latents = embed_motions(judge.motions, made, [t.present for t in some])
                out[LATENT[role]] = latents.numpy()
        return out

    def perform(self, draw: int, piece: slice) -> Arrays:
        """Motions for the captions of some clips, as latents and by whether they do what is said."""
        assert self.bundle is not None
        truths = self.truths[piece]
        fps = self.dataset.layout.fps
        recorded = self.config.lengths == "recorded"
        seed, noise_seed = self.seeds(draw, piece.start)
        request = Request.of(
            [t.caption for t in truths],
            face=[t.face_caption for t in truths],
            seconds=recorded_seconds(truths, self.bundle.generator) if recorded else None,
            seed=seed,
            noise_seed=noise_seed,
            sampling=self.config.sampling,
        )
        motions = generate(self.bundle, request)
        made_for = [
            Performance(m.joints, t.joints, fps, m.face, t.truth)
            for t, m in zip(truths, motions, strict=True)
        ]
        out = as_table([measure_clip(metrics_of("captions"), one) for one in made_for], CLIP)
        moves = all_features((m.joints for m in motions), fps)
        out |= {MOVEMENT + kind: rows for kind, rows in moves.items()}
        if draw == 0:
            out |= as_shown(made_for)
        for role, judge in self.performed_by.items():
            faces = judge.of_faces
            pairs = zip(truths, motions, strict=True)
            shown = [
                (t, m.face if faces else m.features) for t, m in pairs if t.face is not None or not faces
            ]
            made = [x for _, x in shown if x is not None]
            if made:
                # By what the clip holds, as the recording is judged: else hands would tell the two apart.
                held = [t.present for t, x in shown if x is not None]
                out[LATENT[role]] = embed_motions(judge.motions, made, held).numpy()
        return out
